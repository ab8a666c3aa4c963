// Draws the strip chart of the last minute, the plot of a whole run, and the map of the directions of the rod that a run has
// covered.
/* global uPlot */

import { $, duration } from "./live.js";

const MINUTE_S = 60;
const CELLS = 36;
// Longest pause between two moments that the chart bridges with a line [s]. A longer pause is drawn as a gap.
const GAP_S = 1;
const RESTARTED = "angles from zero";

const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

// Returns the colour of a CSS variable. Browsers evaluate `light-dark()` only for an element, so a temporary element is used.
function resolved(name) {
  const probe = document.createElement("i");
  probe.style.color = colour(name);
  document.body.append(probe);
  const value = getComputedStyle(probe).color;
  probe.remove();
  return value;
}

const MARK_CHARS = 24;

// Draws a vertical line at each marker, with the text of the marker.
function draw_marks({ ctx, bbox, scales, valToPos }, marks) {
  ctx.save();
  ctx.strokeStyle = ctx.fillStyle = resolved("--ink");
  ctx.lineWidth = devicePixelRatio;
  ctx.setLineDash([4 * devicePixelRatio, 3 * devicePixelRatio]);
  ctx.font = `${12 * devicePixelRatio}px system-ui, sans-serif`;
  ctx.textAlign = "left";
  ctx.textBaseline = "top";
  marks.filter(({ x }) => x >= scales.x.min && x <= scales.x.max).forEach(({ x, text }, index) => {
    const left = Math.round(valToPos(x, "x", true));
    ctx.beginPath();
    ctx.moveTo(left, bbox.top);
    ctx.lineTo(left, bbox.top + bbox.height);
    ctx.stroke();
    const short = text.length > MARK_CHARS ? `${text.slice(0, MARK_CHARS - 1)}…` : text;
    // Write the texts at three alternating heights, so that adjacent texts do not overlap.
    ctx.fillText(short, left + 4 * devicePixelRatio, bbox.top + (2 + 15 * (index % 3)) * devicePixelRatio);
  });
  ctx.restore();
}

function options(joints, width, height, time) {
  const axis = { stroke: resolved("--quiet"), grid: { stroke: resolved("--line") }, ticks: { stroke: resolved("--line") } };
  const degrees = (_, value) => (value === null || value === undefined ? "–" : `${value.toFixed(1)}°`);
  return {
    width,
    height,
    cursor: { y: false },
    hooks: { draw: [(drawn) => draw_marks(drawn, time.marks())] },
    legend: { live: time.live },
    scales: { x: { time: false, range: time.range } },
    axes: [{ ...axis, values: (_, splits) => splits.map((s) => `${s} s`) }, { ...axis, size: 60 }],
    series: [
      { label: "time", value: (_, value) => (value === null || value === undefined ? "–" : `${value.toFixed(1)} s`) },
      ...joints.map((joint) => ({
        label: `joint ${joint}`, stroke: resolved(`--joint${joint}`), width: 2, points: { show: false }, value: degrees,
      })),
    ],
  };
}

// Creates a chart that fills its container `place`. The chart is built again when size or colour scheme change. `time`
// contains the range of the time axis [s], the markers to be drawn, and whether the legend follows the cursor.
function chart(place, joints, time) {
  let data = [[], ...joints.map(() => [])];
  let drawn;
  const build = () => {
    drawn?.destroy();
    const width = Math.max(place.clientWidth, 200);
    drawn = new uPlot(options(joints, width, Math.min(360, Math.max(220, width * 0.3)), time), data, place);
  };
  const resize = new ResizeObserver(() => { if (drawn && Math.abs(drawn.width - place.clientWidth) > 4) build(); });
  const dark = matchMedia("(prefers-color-scheme: dark)");
  resize.observe(place);
  dark.addEventListener("change", build);
  build();
  return {
    show(next) { data = next; drawn.setData(data); },
    close() { resize.disconnect(); dark.removeEventListener("change", build); drawn.destroy(); },
  };
}

export class Strip {
  // Angles of all joints, the oldest first.
  points = [];
  marks = [];

  // Restores the angles of the last minute from the service, when the page has been opened or has connected again.
  recall({ at_ms, angles_deg }) {
    this.points = at_ms.map((ms, at) => ({ at_s: ms / 1000, angles: angles_deg.map((angles) => angles[at]) }));
  }

  add(moment) {
    const at_s = moment.at_ms / 1000;
    const joints = moment.joints.map((joint) => joint.joint);
    if (joints.join() !== this.joints?.join()) {
      if (!joints.length) return;
      this.joints = joints;
      if (this.points[0]?.angles.length !== joints.length) this.points = [];
      this.drawn?.close();
      const marks = () => this.marks.map((mark) => ({ x: mark.at_s - this.points.at(-1).at_s, text: mark.text }));
      this.drawn = chart($("strip"), joints, { live: false, range: [-MINUTE_S, 0], marks });
    }
    const last = this.points.at(-1);
    if (last && at_s - last.at_s > GAP_S) this.points.push({ at_s: last.at_s + 0.001, angles: joints.map(() => null) });
    // If time has jumped back, the service has another clock, so the chart begins again. The first moments after `recall` may
    // be contained in the restored angles already, so they are ignored.
    if (last && last.at_s - at_s > GAP_S) this.points = [];
    else if (last && at_s <= last.at_s) return;
    this.points.push({ at_s, angles: moment.joints.map((joint) => joint.angle_deg) });
    while (at_s - this.points[0].at_s > MINUTE_S) this.points.shift();
    this.mark(moment, at_s);
    if (document.hidden) return;
    this.drawn.show([
      this.points.map((point) => point.at_s - at_s),
      ...joints.map((_, index) => this.points.map((point) => point.angles[index])),
    ]);
  }

  // Updates the markers: those of the run, even after its end, and one at the time when angles restarted from zero.
  mark({ status, run_s, restarted }, at_s) {
    if (status.run) {
      const begun_s = at_s - (run_s ?? 0);
      this.marks = status.run.marks.map((mark) => ({ at_s: begun_s + mark.at_s, text: mark.text }));
    } else {
      this.marks = this.marks.filter((mark) => mark.text !== RESTARTED);
    }
    if (restarted) this.marks.push({ at_s: restarted.at_ms / 1000, text: RESTARTED });
    this.marks = this.marks.filter((mark) => at_s - mark.at_s < MINUTE_S);
    const texts = this.marks.map((mark) => `${mark.text}, ${Math.round(at_s - mark.at_s)} s ago`);
    const label = `Angles of all joints.${texts.length ? ` Markers: ${texts.join("; ")}.` : ""}`;
    if ($("strip").ariaLabel !== label) $("strip").ariaLabel = label;
  }
}

// Plots a finished run in a dialog.
export function plot({ t_s, joints }, run_marks) {
  const marks = () => run_marks.map((mark) => ({ x: mark.at_s, text: mark.text }));
  const place = $("plot-chart");
  const numbers = joints.map((joint) => joint.joint);
  const drawn = chart(place, numbers, { live: true, range: (_, low, high) => [low, Math.max(high, low + 1)], marks });
  drawn.show([t_s, ...joints.map((joint) => joint.angle_deg)]);
  $("plot").addEventListener("close", () => drawn.close(), { once: true });
}

// Draws the map of the covered directions of the rod (`Coverage` in control/live.rs). Returns a description of the map.
export function cover({ cells, here, visited, newest_s, absolute }, restarted) {
  const canvas = $("cover");
  const context = canvas.getContext("2d");
  const size = canvas.width / CELLS;
  context.clearRect(0, 0, canvas.width, canvas.height);
  context.fillStyle = resolved("--line");
  for (let line = 0; line <= CELLS; line += 9) {
    context.fillRect(line * size, 0, 1, canvas.height);
    context.fillRect(0, line * size, canvas.width, 1);
  }
  context.fillStyle = resolved("--good");
  [...cells].forEach((digit, index) => {
    const bits = parseInt(digit, 16);
    for (let bit = 0; bit < 4; bit += 1) {
      if (!(bits & (8 >> bit))) continue;
      const cell = index * 4 + bit;
      context.fillRect((cell % CELLS) * size + 0.5, (CELLS - 1 - Math.floor(cell / CELLS)) * size + 0.5, size - 1, size - 1);
    }
  });
  if (here) {
    context.strokeStyle = resolved("--ink");
    context.lineWidth = 3;
    context.strokeRect(here[0] * size - 2, (CELLS - 1 - here[1]) * size - 2, size + 4, size + 4);
  }
  const newest = newest_s === null ? "" : newest_s < 5 ? "It is still growing." : `Nothing new for ${Math.round(newest_s)} s.`;
  const axes = absolute
    ? "Joint 1 across, joint 2 up, -180 to 180 degrees."
    : "Joint 1 across, joint 2 up; zero is unknown (home, and set mark_deg in ball_bar.toml).";
  const since = restarted?.run_s ?? null;
  const restart_text = since === null ? "" : ` since the outage at ${duration(since)}; ${restarted.cells_before} before it`;
  return `${visited} cells of 10 degrees${restart_text}. ${newest}\n${axes}`;
}
