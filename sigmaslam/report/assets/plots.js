"use strict";
// Plots over time, with one cursor for all of them; frames without a pose of their own are shaded. Runs have times of
// their own.
const SHADES = { lost: "rgb(213 94 0 / 25%)", starting: "rgb(120 120 120 / 18%)", relocalised: "rgb(204 121 167 / 45%)",
  skipped: "rgb(120 120 120 / 35%)", doubtful: "rgb(240 208 63 / 35%)", ambiguous: "rgb(181 123 255 / 35%)",
  inertial: "rgb(79 195 161 / 25%)", odometry: "rgb(161 195 79 / 25%)" };

function shadeStatuses(intervals) {
  return (plot) => {
    const { ctx, bbox } = plot;
    ctx.save();
    for (const { first, last, status } of intervals) {
      if (!SHADES[status]) continue;
      const [from, to] = [first, last].map((x) => plot.valToPos(x, "x", true));
      const left = Math.max(from, bbox.left), right = Math.min(Math.max(to, from + 1), bbox.left + bbox.width);
      ctx.fillStyle = SHADES[status];
      if (right > left) ctx.fillRect(left, bbox.top, right - left, bbox.height);
    }
    ctx.restore();
  };
}

function buildPlot(box, seconds, intervals, plot, select) {
  const style = getComputedStyle(document.documentElement);
  const [soft, line] = ["--soft", "--line"].map((name) => style.getPropertyValue(name).trim());
  const clean = (values) => Array.from(values, (value) => (Number.isFinite(value) && (!plot.log || value > 0) ? value : null));
  const write = (_, value) => (value === null || value === undefined ? "–" : Number(value.toPrecision(4)).toString());
  const axis = { stroke: soft, grid: { stroke: line, width: 1 }, ticks: { stroke: line, width: 1 } };
  const upright = { ...axis, size: 62, values: (_, ticks) => ticks.map((tick) => (tick === null ? "" : write(_, tick))) };
  const series = plot.series.map((each) => ({
    label: each.label, stroke: each.colour, width: each.width ?? 1.5, dash: each.dash, fill: each.fill, value: write, class: each.label ? undefined : "nameless",
    points: { show: Boolean(each.dots), size: 4, fill: each.dots ? each.colour : undefined }, paths: each.dots ? () => null : undefined, spanGaps: false,
  }));
  const options = {
    width: box.clientWidth, height: 230, cursor: { sync: { key: "run" } },
    scales: { x: { time: false }, y: plot.log ? { distr: 3 } : { range: plot.range } },
    series: [{ label: "time [s]", value: write }, ...series], bands: plot.bands, axes: [axis, upright],
    hooks: { drawClear: [shadeStatuses(intervals)] },
  };
  if (!plot.log && !plot.range) delete options.scales.y;
  const tables = plot.series.map((each) => [Array.from(seconds[each.run ?? 0]), clean(each.values)]);
  const made = new uPlot(options, uPlot.join(tables), box);
  made.over.addEventListener("click", () => {
    if (made.cursor.idx !== null && made.cursor.idx !== undefined) select(made.data[0][made.cursor.idx]);
  });
  new ResizeObserver(() => made.setSize({ width: box.clientWidth, height: 230 })).observe(box);
  return made;
}
