// The last minutes as curves: where the robot is, how far its sliders are behind, and how late its loop is.

import uPlot from "./uplot.js";
import { unit } from "./units.js";
import { number, say, time } from "./words.js";

const KEPT = 180; // seconds
const EVERY = 100; // between two points [ms]
const DRAWN = 250; // between two drawings [ms]
const LOW = 124; // as high is a chart where the page scrolls, and at least [px]
const TITLE = 21; // of that its title [px]
const PHI = 180 / Math.PI;

const DESK = matchMedia("(min-width: 1000px)"); // as the style sheet: there they share the height that there is

const byId = (id) => document.getElementById(id);
const style = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

export class Charts {
  constructor() {
    this.clear();
    this.last = -Infinity;
    this.drawn = -Infinity;
    this.plots = [];
  }

  clear() {
    this.times = [];
    this.rows = []; // x, y in the unit of the page, φ [°], following error of each slider [µm], lateness [µs]
  }

  // Draw anew, for this robot and in the language of now.
  robot({ sliders, colours, resolution, state_timeout }) {
    if (this.scale !== resolution.scale) this.clear(); // they are in another unit
    this.scale = resolution.scale;
    this.longest = state_timeout; // between two points of a line [s]
    for (const plot of this.plots) plot.destroy();
    const [x, y, phi] = ["--accent", "--second", "--third"].map(style);
    this.plots = [
      plot(`x, y [${unit()}]`, [["x", x], ["y", y]], [0, 1]),
      plot("φ [°]", [["φ", phi]], [2]),
      plot(say("chart.error"), sliders.map((name, k) => [name, colours.sliders[k]]), [3, 4, 5]),
      plot(say("chart.lateness"), [[say("chart.late"), x]], [6], true),
    ];
  }

  state({ pose, sliders, loop }, now) {
    if (now - this.last < EVERY) return;
    this.last = now;
    if (Date.now() / 1e3 - this.times.at(-1) > this.longest) this.lost(); // the page was hidden, or the machine slept
    this.#add([pose[0] * this.scale, pose[1] * this.scale, pose[2] * PHI, ...sliders.following_error.map((each) => each * 1e6), loop.lateness_us.p99]);
    if (now - this.drawn < DRAWN || byId("charts").hidden) return;
    this.drawn = now;
    this.draw();
  }

  // A time without contact is a gap.
  lost() {
    if (!this.rows.length || this.rows.at(-1)[0] === null) return;
    this.#add(Array(7).fill(null));
  }

  // What is drawn must be in order of time: after a clock that was set back the curves begin anew.
  #add(row) {
    const at = Date.now() / 1e3;
    if (at < this.times.at(-1)) this.clear();
    this.times.push(at);
    this.rows.push(row);
    while (at - this.times[0] > KEPT) {
      this.times.shift();
      this.rows.shift();
    }
  }

  draw() {
    const { clientWidth: width, clientHeight } = byId("charts");
    const share = DESK.matches ? Math.floor(clientHeight / this.plots.length) : LOW;
    for (const each of this.plots) {
      const height = Math.max(LOW, share) - TITLE;
      if (each.width !== width || each.height !== height) each.setSize({ width, height });
      each.setData([this.times, ...each.columns.map((column) => this.rows.map((row) => row[column]))]);
    }
  }
}

// The last one has the times below it, for all of them.
function plot(title, lines, columns, last = false) {
  const axis = { stroke: style("--quiet"), grid: { stroke: style("--raised") }, ticks: { stroke: style("--raised") } };
  const series = lines.map(([label, stroke]) => ({ label, stroke, width: 1.5, spanGaps: false, points: { show: false } }));
  const clock = (_, times) => times.map((each) => (last ? time(each) : ""));
  const made = new uPlot(
    { title, width: 300, height: LOW, legend: { show: lines.length > 1, live: false }, cursor: { show: false }, axes: [{ ...axis, values: clock, space: 90, size: last ? 30 : 8 }, { ...axis, size: 60, space: 22, values: (_, values) => values.map((each) => number(each, 0, 6)) }], series: [{}, ...series] },
    [[], ...lines.map(() => [])],
    byId("charts"),
  );
  made.columns = columns;
  return made;
}
