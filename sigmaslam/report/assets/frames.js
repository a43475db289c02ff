"use strict";
// The strip of frames: one picture at a time with its matches, their trails and their ellipses.
function buildFrames(pictures, size, magnification, chosen) {
  const canvas = document.getElementById("frame"), slider = document.getElementById("slider");
  const about = document.getElementById("frame-text");
  const images = pictures.map((picture) => Object.assign(new Image(), { src: picture.left }));
  let now = 0;

  const ellipse = (context, u, v, a, b, c, scale) => {
    // Half axes and direction of the covariance [[a, b], [b, c]].
    const middle = (a + c) / 2, root = Math.hypot((a - c) / 2, b);
    const axes = [middle + root, Math.max(middle - root, 0)].map((v) => 3 * magnification * scale * Math.sqrt(v));
    if (!axes.every(Number.isFinite) || axes[0] > context.canvas.width) return;
    context.beginPath();
    context.ellipse(u, v, axes[0], axes[1], 0.5 * Math.atan2(2 * b, a - c), 0, 2 * Math.PI);
    context.stroke();
  };

  const draw = () => {
    const picture = pictures[now], image = images[now];
    if (!image.complete) { image.onload = draw; return; }
    const columns = picture.right ? 2 : 1, zoom = columns === 2 ? 1 : 2;
    const [width, height] = [zoom * image.naturalWidth, zoom * image.naturalHeight];
    Object.assign(canvas, { width: columns * width, height });
    const context = canvas.getContext("2d");
    context.drawImage(image, 0, 0, width, height);
    if (picture.right) {
      const right = Object.assign(new Image(), { src: picture.right });
      right.onload = () => pictures[now] === picture && context.drawImage(right, width, 0, width, height);
    }
    const scale = width / size[0];
    const { pixels, covariance, probability, inlier, trail } = picture;
    const steps = pixels.length ? trail.length / pixels.length : 0;
    for (let k = 0; k < probability.length; k++) {
      const [u, v] = [scale * (pixels[2 * k] + 0.5), scale * (pixels[2 * k + 1] + 0.5)];
      if (!inlier[k]) {
        context.strokeStyle = "#ff4d3d";
        context.lineWidth = 1.5;
        context.beginPath();
        for (const sign of [-1, 1]) { context.moveTo(u - 4, v - 4 * sign); context.lineTo(u + 4, v + 4 * sign); }
        context.stroke();
        continue;
      }
      const rgb = viridis(probability[k]).map((share) => Math.round(255 * share));
      context.strokeStyle = `rgb(${rgb})`;
      context.lineWidth = 2;
      context.beginPath();
      context.moveTo(u, v);
      for (let step = 0; step < steps; step++) {
        const at = 2 * (k * steps + step);
        if (!Number.isFinite(trail[at])) break;
        context.lineTo(scale * (trail[at] + 0.5), scale * (trail[at + 1] + 0.5));
      }
      context.stroke();
      context.lineWidth = 1;
      context.globalAlpha = 0.7;
      ellipse(context, u, v, covariance[4 * k], covariance[4 * k + 1], covariance[4 * k + 3], scale);
      context.globalAlpha = 1;
    }
    about.textContent = picture.label;
  };

  const show = (index) => {
    now = index;
    slider.value = index;
    document.querySelectorAll(".strip button").forEach((each) => each.classList.toggle("now", +each.dataset.k === now));
    draw();
  };
  for (const [id, rows] of [["strip", pictures.map((_, k) => k)], ["worst", worstFirst(pictures)]]) {
    for (const k of rows) {
      const button = document.createElement("button");
      button.dataset.k = k;
      button.title = pictures[k].label;
      button.classList.toggle("lost", pictures[k].is_lost);
      button.append(Object.assign(new Image(), { src: pictures[k].left, alt: `frame at ${pictures[k].seconds} s` }));
      if (id === "worst") button.append(Object.assign(document.createElement("span"), { textContent: pictures[k].why }));
      button.addEventListener("click", () => { show(k); chosen(pictures[k].seconds); });
      document.getElementById(id).append(button);
    }
  }
  slider.max = pictures.length - 1;
  slider.addEventListener("input", () => { show(+slider.value); chosen(pictures[+slider.value].seconds); });
  show(Math.floor(pictures.length / 2));
  return {
    select: (seconds) => {
      const gaps = pictures.map((picture) => Math.abs(picture.seconds - seconds));
      show(gaps.indexOf(Math.min(...gaps)));
    },
  };
}

function worstFirst(pictures) {
  const worst = pictures.map((_, k) => k).filter((k) => pictures[k].rank !== null);
  return worst.sort((a, b) => pictures[a].rank - pictures[b].rank);
}
