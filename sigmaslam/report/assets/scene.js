"use strict";
// The 3D view: paths by status, or of several runs by run, ellipsoids, map points, keyframes, loops; y of the world
// points down.
// Colours by number of the status, as in `statuses` of the page's data.
const STATUS_COLOURS = ["#9aa3ad", "#3fa7f0", "#ff6a3d", "#e08bc0", "#6b7280", "#f0d03f", "#b57bff", "#4fc3a1",
  "#a1c34f"];
const LOST_STATUSES = new Set([0, 2]);
// Viridis in nine steps.
const VIRIDIS = ["#440154", "#472d7b", "#3b528b", "#2c728e", "#21918c", "#28ae80", "#5ec962", "#addc30", "#fde725"];

function viridis(share) {
  const place = Math.min(Math.max(share, 0), 1) * (VIRIDIS.length - 1);
  const low = Math.min(Math.floor(place), VIRIDIS.length - 2);
  const ends = [VIRIDIS[low], VIRIDIS[low + 1]].map((hex) => parseInt(hex.slice(1), 16));
  return [16, 8, 0].map((shift) => {
    const [a, b] = ends.map((value) => (value >> shift) & 255);
    return (a + (b - a) * (place - low)) / 255;
  });
}

function lineSegments(positions, colours, options) {
  const geometry = new THREE.LineSegmentsGeometry();
  geometry.setPositions(positions);
  if (colours) geometry.setColors(colours);
  const material = new THREE.LineMaterial({ vertexColors: Boolean(colours), ...options });
  const line = new THREE.LineSegments2(geometry, material);
  line.computeLineDistances();
  return line;
}

function polyline(points, options) {
  const positions = [];
  for (let k = 3; k < points.length; k += 3) positions.push(...points.subarray(k - 3, k + 3));
  return lineSegments(positions, null, options);
}

function pathLines(scene, dash) {
  const parts = { sure: [[], []], guess: [[], []] };
  for (let k = 1; k < scene.path_status.length; k++) {
    const guess = LOST_STATUSES.has(scene.path_status[k]) || (k > 1 && LOST_STATUSES.has(scene.path_status[k - 1]));
    const [positions, colours] = parts[guess ? "guess" : "sure"];
    const status = guess && !LOST_STATUSES.has(scene.path_status[k]) ? scene.path_status[k - 1] : scene.path_status[k];
    const colour = new THREE.Color(scene.colour ?? STATUS_COLOURS[status]);
    positions.push(...scene.path.subarray(3 * k - 3, 3 * k + 3));
    for (let end = 0; end < 2; end++) colours.push(colour.r, colour.g, colour.b);
  }
  const group = new THREE.Group();
  if (parts.sure[0].length) group.add(lineSegments(...parts.sure, { linewidth: 3 }));
  const dashed = { linewidth: 2.5, dashed: true, dashSize: dash, gapSize: dash };
  if (parts.guess[0].length) group.add(lineSegments(...parts.guess, dashed));
  return group;
}

function mapPoints(scene, by) {
  const count = scene.points.length / 3;
  const colours = new Float32Array(3 * count);
  // Sigmas span decades: colours go by their logarithm, between the 5th and the 95th percentile.
  const logs = scene.point_sigma.map((sigma) => Math.log(Math.max(sigma, 1e-9)));
  const sorted = Float32Array.from(logs).sort();
  const [low, high] = [0.05, 0.95].map((share) => sorted[Math.floor(share * (count - 1))]);
  for (let k = 0; k < count; k++) {
    const grey = by === "grey" ? (60 + 0.76 * scene.point_grey[k]) / 255 : 0;
    const rgb = by === "grey" ? [grey, grey, grey] : viridis((logs[k] - low) / Math.max(high - low, 1e-9));
    const colour = new THREE.Color().setRGB(...rgb, "srgb");
    colours.set([colour.r, colour.g, colour.b], 3 * k);
  }
  return colours;
}

// Lines of the first camera's horizontal plane below the path, a round number of metres apart.
function grid(scene) {
  const decade = 10 ** Math.floor(Math.log10(scene.size / 8));
  const spacing = decade * [5, 2, 1].find((factor) => factor * decade <= scene.size / 8);
  const [x, , z] = scene.centre.map((value) => spacing * Math.round(value / spacing));
  let floor = -Infinity;
  for (let k = 1; k < scene.path.length; k += 3) floor = Math.max(floor, scene.path[k]);
  floor += scene.size / 30;
  const positions = [];
  for (let k = -6; k <= 6; k++) {
    const [a, b] = [k * spacing, 6 * spacing];
    positions.push(x + a, floor, z - b, x + a, floor, z + b, x - b, floor, z + a, x + b, floor, z + a);
  }
  const made = lineSegments(positions, null, { linewidth: 1, color: "#33404c" });
  made.spacing = spacing;
  return made;
}

function frustums(scene, size) {
  const corners = [[-1, -0.6, 1.2], [1, -0.6, 1.2], [1, 0.6, 1.2], [-1, 0.6, 1.2]].map((c) => c.map((v) => v * size));
  const positions = [];
  for (let k = 0; k < scene.keyframes.length; k += 16) {
    const pose = new THREE.Matrix4().fromArray(scene.keyframes, k).transpose();
    const [apex, ...rim] = [[0, 0, 0], ...corners].map((c) => new THREE.Vector3(...c).applyMatrix4(pose));
    rim.forEach((corner, i) => positions.push(...apex, ...corner, ...corner, ...rim[(i + 1) % 4]));
  }
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.BufferAttribute(Float32Array.from(positions), 3));
  return new THREE.LineSegments(geometry, new THREE.LineBasicMaterial({ color: "#7fd6b3", transparent: true,
    opacity: 0.6 }));
}

function ellipsoids(scene) {
  const count = scene.ellipsoid_status.length;
  // Those that fill the view, of frames that are lost, would hide all else: they are fainter.
  const meshes = [0.28, 0.05].map((opacity) => {
    const material = new THREE.MeshLambertMaterial({ transparent: true, opacity, depthWrite: false });
    const mesh = new THREE.InstancedMesh(new THREE.SphereGeometry(1, 32, 24), material, count);
    mesh.frustumCulled = false;
    for (let k = 0; k < count; k++) mesh.setColorAt(k, new THREE.Color(scene.colour ?? STATUS_COLOURS[scene.ellipsoid_status[k]]));
    return mesh;
  });
  const group = new THREE.Group();
  group.add(...meshes);
  group.magnify = (factor) => {
    for (let k = 0; k < count; k++) {
      const matrix = new THREE.Matrix4().fromArray(scene.ellipsoids, 16 * k).transpose();
      const e = matrix.elements;
      for (const axis of [0, 4, 8]) for (let i = 0; i < 3; i++) e[axis + i] *= 3 * factor;
      const isLarge = Math.hypot(...[0, 1, 2, 4, 5, 6, 8, 9, 10].map((i) => e[i])) > scene.size / 4;
      const nothing = new THREE.Matrix4().makeScale(0, 0, 0);
      meshes.forEach((mesh, large) => mesh.setMatrixAt(k, isLarge === Boolean(large) ? matrix : nothing));
    }
    for (const mesh of meshes) mesh.instanceMatrix.needsUpdate = true;
  };
  group.magnify(scene.magnification);
  return group;
}

// Points of surfaces, in the colours of the images.
function surfaces(scene) {
  const cloud = new THREE.BufferGeometry();
  cloud.setAttribute("position", new THREE.BufferAttribute(scene.dense, 3));
  cloud.setAttribute("color", new THREE.BufferAttribute(scene.dense_colours, 3, true));
  const size = scene.size / 400;
  return new THREE.Points(cloud, new THREE.PointsMaterial({ size, vertexColors: true }));
}

// Centre and size are those of the first scene, which has the map.
function buildScene(box, scenes, select) {
  const scene = scenes[0];
  let renderer;
  try {
    renderer = new THREE.WebGLRenderer({ antialias: true });
  } catch (error) {
    box.insertAdjacentHTML("beforeend", '<p class="none">This browser shows no WebGL, which the 3D view needs.</p>');
    return null;
  }
  box.prepend(renderer.domElement);
  renderer.setClearColor("#14181d");
  renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
  const world = new THREE.Scene();
  const camera = new THREE.PerspectiveCamera(45, 1, scene.size / 1000, scene.size * 100);
  camera.up.set(0, -1, 0);
  const controls = new THREE.OrbitControls(camera, renderer.domElement);
  const target = new THREE.Vector3(...scene.centre);
  world.add(new THREE.AmbientLight("#ffffff", 2));
  const sun = new THREE.DirectionalLight("#ffffff", 2);
  sun.position.set(-1, -2, -1);
  world.add(sun);

  const layers = {}, clouds = scenes.map(ellipsoids);
  scenes.forEach((each, k) => { layers[`path-${k}`] = pathLines(each, scene.size / 90); });
  layers.ellipsoids = new THREE.Group().add(...clouds);
  const cloud = new THREE.BufferGeometry();
  cloud.setAttribute("position", new THREE.BufferAttribute(scene.points, 3));
  const colourBy = (by) => cloud.setAttribute("color", new THREE.BufferAttribute(mapPoints(scene, by), 3));
  colourBy(scene.point_grey ? "grey" : "sigma");
  layers.points = new THREE.Points(cloud, new THREE.PointsMaterial({ size: 2.6 * renderer.getPixelRatio(),
    sizeAttenuation: false, vertexColors: true }));
  if (scene.dense) layers.dense = surfaces(scene);
  layers.grid = grid(scene);
  box.querySelector(".scale").textContent = `grid: ${length(layers.grid.spacing)}`;
  if (!scene.colour) {
    layers.keyframes = frustums(scene, scene.size / 130);
    layers.loops = lineSegments(scene.loops, null, { linewidth: 2, color: "#ffb000" });
  }
  for (const [name, colour] of [["truth", scene.colour ? "#f5f5f5" : "#00c08a"], ["final", "#f0e442"], ["refined", "#e0aaff"]]) {
    const line = scenes.find((each) => each[name]);
    if (line) layers[name] = polyline(line[name], { linewidth: 1.6, color: colour });
  }
  Object.values(layers).forEach((layer) => world.add(layer));
  const tips = [0, 1, 2].map((axis) => new THREE.Vector3().setComponent(axis, scene.size / 14).toArray());
  const hues = [[1, 0.25, 0.25], [0.2, 0.85, 0.3], [0.35, 0.5, 1]];
  world.add(lineSegments(tips.flatMap((end) => [0, 0, 0, ...end]), hues.flatMap((hue) => [...hue, ...hue]),
    { linewidth: 2.5 }));
  const markers = scenes.map((each) => {
    const material = new THREE.MeshBasicMaterial({ color: each.colour ?? "#ffffff" });
    const marker = new THREE.Mesh(new THREE.SphereGeometry(1, 16, 12), material);
    marker.visible = false;
    world.add(marker);
    return marker;
  });

  const tip = box.querySelector(".tip");
  let asked = false;
  const draw = () => {
    asked = false;
    for (const marker of markers) marker.scale.setScalar(camera.position.distanceTo(marker.position) / 130);
    renderer.render(world, camera);
  };
  const redraw = () => { if (!asked) { asked = true; requestAnimationFrame(draw); } };
  const resize = () => {
    const [width, height] = [box.clientWidth, box.clientHeight];
    renderer.setSize(width, height);
    camera.aspect = width / height;
    camera.updateProjectionMatrix();
    redraw();
  };
  const view = (direction) => {
    const reach = (0.6 * scene.size) / Math.tan((22.5 * Math.PI) / 180) / Math.min(camera.aspect, 1.3);
    controls.target.copy(target);
    camera.position.copy(target).addScaledVector(new THREE.Vector3(...direction).normalize(), reach);
    controls.update();
    redraw();
  };
  const views = { oblique: scene.extent[2] > scene.extent[0] ? [-1, -0.8, -0.4] : [-0.4, -0.8, -1], above: [0, -1, -1e-4], side: [-1, -0.02, 0], behind: [0, -0.05, -1] };

  // The nearest vertex of the path, or else of the map, within 12 pixels.
  const projected = new THREE.Vector3();
  const nearest = (points, x, y) => {
    let best = -1, distance = 144;
    for (let k = 0; k < points.length / 3; k++) {
      projected.fromArray(points, 3 * k).project(camera);
      if (projected.z > 1) continue;
      const dx = (projected.x + 1) * 0.5 * box.clientWidth - x, dy = (1 - projected.y) * 0.5 * box.clientHeight - y;
      if (dx * dx + dy * dy < distance) [best, distance] = [k, dx * dx + dy * dy];
    }
    return best;
  };
  const describe = (x, y) => {
    for (const [k, each] of scenes.entries()) {
      const frame = layers[`path-${k}`].visible ? nearest(each.path, x, y) : -1;
      if (frame >= 0) return [(each.name ? `${each.name}: ` : "") + each.labels[frame], each.path_seconds[frame]];
    }
    if (!layers.points.visible) return ["", null];
    const point = nearest(scene.points, x, y);
    return [point < 0 ? "" : `map point, sigma ${length(scene.point_sigma[point])}`, null];
  };
  const place = (event) => {
    const edge = box.getBoundingClientRect();
    return [event.clientX - edge.left, event.clientY - edge.top];
  };
  box.addEventListener("pointermove", (event) => {
    if (event.buttons) return;
    const [x, y] = place(event), [text] = describe(x, y);
    tip.textContent = text;
    tip.style.display = text ? "block" : "none";
    tip.style.left = `${Math.min(x + 14, box.clientWidth - 210)}px`;
    tip.style.top = `${Math.max(y - 34, 4)}px`;
  });
  box.addEventListener("click", (event) => {
    const [, seconds] = describe(...place(event));
    if (seconds !== null) select(seconds);
  });
  controls.addEventListener("change", redraw);
  new ResizeObserver(resize).observe(box);
  resize();
  view(views.oblique);
  return {
    camera, layers,
    look: (name) => view(views[name]),
    show: (name, visible) => { if (layers[name]) layers[name].visible = visible; redraw(); },
    colourBy: (by) => { colourBy(by); redraw(); },
    magnify: (factor) => { for (const cloud of clouds) cloud.magnify(factor); redraw(); },
    select: (seconds, follow) => {
      scenes.forEach((each, k) => {
        const frame = nearestFrame(each.path_seconds, seconds);
        markers[k].visible = frame >= 0;
        if (frame >= 0) markers[k].position.fromArray(each.path, 3 * frame);
      });
      const followed = markers.find((marker) => marker.visible);
      if (follow && followed) {
        camera.position.add(followed.position).sub(controls.target);
        controls.target.copy(followed.position);
        controls.update();
      }
      redraw();
    },
  };
}

function length(metres) {
  if (metres >= 1) return `${metres.toPrecision(3)} m`;
  return metres >= 0.01 ? `${(100 * metres).toPrecision(3)} cm` : `${(1000 * metres).toPrecision(3)} mm`;
}
