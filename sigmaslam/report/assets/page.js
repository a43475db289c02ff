"use strict";
// Puts the page together: the data, one time for all views, and the buttons.
const ARRAYS = { "<f4": Float32Array, "|u1": Uint8Array };

// Arrays stand in the page's JSON as {"dtype", "base64"}, of any shape, rows first.
function unpacked(_, value) {
  if (value === null || typeof value !== "object" || !("base64" in value)) return value;
  const bytes = Uint8Array.from(atob(value.base64), (letter) => letter.charCodeAt(0));
  return new ARRAYS[value.dtype](bytes.buffer);
}

const page = JSON.parse(document.getElementById("data").textContent, unpacked);
let scene = null, frames = null, timeline = null;
const plots = [];

function select(seconds, from) {
  if (scene) scene.select(seconds, document.getElementById("follow").checked);
  if (timeline && from !== "timeline") timeline.select(seconds);
  if (frames && from !== "frames") frames.select(seconds);
  for (const plot of plots) plot.setCursor({ left: plot.valToPos(seconds, "x"), top: 10 }, false);
}

if (page.scenes.length) {
  scene = buildScene(document.getElementById("scene"), page.scenes, select);
  const press = (button, on) => button.setAttribute("aria-pressed", String(on));
  document.querySelectorAll("[data-layer]").forEach((button) => button.addEventListener("click", () => {
    const on = button.getAttribute("aria-pressed") !== "true";
    press(button, on);
    scene?.show(button.dataset.layer, on);
  }));
  document.querySelectorAll("[data-view]").forEach((button) => {
    button.addEventListener("click", () => scene?.look(button.dataset.view));
  });
  document.querySelectorAll("[data-colour]").forEach((button) => button.addEventListener("click", () => {
    document.querySelectorAll("[data-colour]").forEach((each) => press(each, each === button));
    scene?.colourBy(button.dataset.colour);
  }));
  if (scene) timeline = buildTimeline(page.scenes, (seconds) => select(seconds, "timeline"));
  const magnification = document.getElementById("magnification");
  magnification.addEventListener("change", () => scene?.magnify(+magnification.value));
}
if (page.pictures.length) {
  frames = buildFrames(page.pictures, page.picture_size, page.picture_magnification,
    (seconds) => select(seconds, "frames"));
}
page.plots.forEach((plot, k) => {
  plots.push(buildPlot(document.getElementById(`plot-${k}`), page.seconds, page.intervals, plot, select));
});
if (timeline) select(Math.max(...page.scenes.map((each) => each.path_seconds.at(-1))));
window.report = { page, scene, frames, plots, timeline };
