"use strict";
// The frame of a run at a time; -1 before its first and after its last one.
function nearestFrame(times, seconds) {
  let k = 0;
  while (k + 1 < times.length && Math.abs(times[k + 1] - seconds) <= Math.abs(times[k] - seconds)) k++;
  return seconds < times[0] - 1e-3 || seconds > times[times.length - 1] + 1e-3 ? -1 : k;
}

// One time for the whole page: a slider, play and keys move it; views, plots and pictures follow.
function buildTimeline(scenes, chosen) {
  const seconds = [...new Set(scenes.flatMap((scene) => Array.from(scene.path_seconds)))].sort((a, b) => a - b);
  const [bar, slider, play, speed, about] = ["timeline", "time", "play", "speed", "time-text"].map((id) => document.getElementById(id));
  let now = seconds.length - 1, playing = false, started = 0, from = 0;

  const show = (index) => {
    now = Math.min(Math.max(index, 0), seconds.length - 1);
    slider.value = now;
    const lines = scenes.map((scene) => {
      const frame = nearestFrame(scene.path_seconds, seconds[now]);
      const label = frame < 0 ? "no pose" : scene.labels[frame].replace("\n", ", ");
      return scene.name ? `${scene.name}: ${label}` : label;
    });
    about.textContent = lines.join("\n");
  };
  const go = (index) => { show(index); chosen(seconds[now]); };
  const nearest = (time) => nearestFrame(seconds, Math.min(Math.max(time, seconds[0]), seconds[seconds.length - 1]));
  const step = (clock) => {
    if (!playing) return;
    const time = from + ((clock - started) / 1000) * +speed.value;
    if (nearest(time) !== now) go(nearest(time));
    if (now === seconds.length - 1) run(false); else requestAnimationFrame(step);
  };
  const run = (on) => {
    playing = on;
    play.textContent = on ? "❚❚" : "▶";
    play.setAttribute("aria-pressed", String(on));
    if (!on) return;
    if (now === seconds.length - 1) go(0);
    [started, from] = [performance.now(), seconds[now]];
    requestAnimationFrame(step);
  };
  slider.max = seconds.length - 1;
  slider.addEventListener("input", () => { run(false); go(+slider.value); });
  play.addEventListener("click", () => run(!playing));
  speed.addEventListener("change", () => { if (playing) run(true); });
  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.altKey || event.metaKey || event.target.closest("input, select, summary, a")) return;
    const steps = { ArrowLeft: now - 1, ArrowRight: now + 1, PageUp: now - 10, PageDown: now + 10, Home: 0, End: seconds.length - 1 };
    if (event.key === " ") run(!playing);
    else if (event.key in steps) { run(false); go(steps[event.key]); }
    else return;
    event.preventDefault();
  });
  bar.hidden = false;
  show(now);
  return { select: (time) => show(nearest(time)) };
}
