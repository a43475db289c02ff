"use strict";
// One time for the whole page: a slider, play and keys move it; views, plots and pictures follow.
function buildTimeline(seconds, labels, chosen) {
  const [bar, slider, play, speed, about] = ["timeline", "time", "play", "speed", "time-text"].map((id) => document.getElementById(id));
  let now = seconds.length - 1, playing = false, started = 0, from = 0;

  const show = (index) => {
    now = Math.min(Math.max(index, 0), seconds.length - 1);
    slider.value = now;
    about.textContent = labels[now].replace("\n", ", ");
  };
  const go = (index) => { show(index); chosen(seconds[now]); };
  const nearest = (time) => {
    let k = 0;
    while (k + 1 < seconds.length && Math.abs(seconds[k + 1] - time) <= Math.abs(seconds[k] - time)) k++;
    return k;
  };
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
