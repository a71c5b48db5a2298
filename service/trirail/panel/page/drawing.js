// The mechanism as an SVG, in metres, y upwards: fixed parts once, the others where a state has them.

const SVG = "http://www.w3.org/2000/svg";
const TICKS = 500; // so many switches are drawn, the newest

export class Drawing {
  constructor(svg, robot) {
    const { parts, legs, colours } = robot;
    this.legs = legs;
    this.ends = parts.cross_slides;
    const [low, high] = parts.bounds;
    const margin = 0.11 * (high[0] - low[0]);
    svg.replaceChildren();
    svg.setAttribute("viewBox", [low[0] - margin, -high[1] - margin, high[0] - low[0] + 2 * margin, high[1] - low[1] + 2 * margin].join(" "));
    svg.style.setProperty("--letter", `${0.06 * (high[0] - low[0])}px`);
    const add = (name, kind, parent = svg, colour = "") => {
      const made = document.createElementNS(SVG, name);
      made.setAttribute("class", kind);
      if (colour) made.style.stroke = colour;
      return parent.appendChild(made);
    };
    const lines = (all, kind, parent = svg) => all.map((line) => {
      const made = add("polyline", kind, parent);
      made.setAttribute("points", points(line));
      return made;
    });
    lines(parts.rails, "rail");
    lines(parts.travel, "travel").forEach((line, k) => { line.style.stroke = colours.sliders[k]; });
    lines(parts.stops, "stop");
    this.goal = add("g", "moving");
    lines(parts.outline, "goal", this.goal);
    this.svg = svg;
    this.chosen = add("g", "");
    lines(parts.outline, "wanted", this.chosen);
    lines(parts.arms, "wanted", this.chosen);
    this.route = add("polyline", "");
    this.ticks = add("g", "");
    this.tickSize = 0.008 * (high[0] - low[0]);
    this.wanted(null, null);
    this.platform = add("g", "moving");
    lines(parts.outline, "platform", this.platform);
    lines(parts.arms, "arm", this.platform);
    lines(parts.edge_stops, "stop", this.platform);
    const centre = add("circle", "centre", this.platform);
    centre.setAttribute("r", 0.012 * (high[0] - low[0]));
    this.point = add("circle", "tool", this.platform);
    this.point.setAttribute("r", 0.012 * (high[0] - low[0]));
    this.tool(null);
    this.sleeves = legs.map((leg, k) => add("line", leg.turns ? "sleeve" : "cross", svg, colours.sliders[k]));
    const dots = (kind, size) => legs.map((_, k) => {
      const dot = add("circle", kind, svg, colours.sliders[k]);
      dot.setAttribute("r", size * (high[0] - low[0]));
      return dot;
    });
    this.carriages = dots("carriage", 0.014);
    this.pivots = dots("pivot", 0.007);
    parts.names.forEach(([x, y], k) => {
      const name = add("text", "");
      name.style.fill = colours.sliders[k];
      name.setAttribute("x", x);
      name.setAttribute("y", -y);
      name.textContent = robot.sliders[k];
    });
  }

  // Show a pose that is chosen; whether it can be gone to, or null where nobody has said.
  wanted(pose, may) {
    this.chosen.style.display = pose ? "" : "none";
    this.chosen.setAttribute("class", may === null ? "" : may ? "free" : "barred");
    if (pose) place(this.chosen, pose);
  }

  // Show a tool, a point (u, v) of the platform; null for none.
  tool(point) {
    this.point.style.display = point ? "" : "none";
    if (point) this.point.setAttribute("transform", `translate(${point[0]} ${-point[1]})`);
  }

  // Show a path of poses; whether it can be followed, or null where nobody has said.
  path(poses, may) {
    this.route.setAttribute("class", may === null ? "route" : may ? "route free" : "route barred");
    this.route.setAttribute("points", points(poses));
  }

  // Mark where an output switches: dashed where planned, filled where it has switched on.
  tick([x, y], kind, title) {
    if (this.ticks.childElementCount >= TICKS) this.ticks.firstChild.remove();
    const dot = this.ticks.appendChild(document.createElementNS(SVG, "circle"));
    dot.setAttribute("class", `tick ${kind}`);
    dot.setAttribute("r", this.tickSize);
    dot.setAttribute("cx", x);
    dot.setAttribute("cy", -y);
    dot.appendChild(document.createElementNS(SVG, "title")).textContent = title;
  }

  clearTicks() {
    this.ticks.replaceChildren();
  }

  // Where a pointer is, in metres.
  place(event) {
    const at = new DOMPoint(event.clientX, event.clientY).matrixTransform(this.svg.getScreenCTM().inverse());
    return [at.x, -at.y];
  }

  show(state) {
    this.svg.classList.toggle("unknown", !state.sliders.homed.every(Boolean));
    place(this.platform, state.pose);
    const target = state.goal?.target;
    this.goal.style.display = target ? "" : "none";
    if (target) place(this.goal, target);
    this.legs.forEach((leg, k) => {
      const along = leg.home + state.sliders.position[k];
      const x = leg.anchor[0] + along * Math.cos(leg.rail_angle);
      const y = leg.anchor[1] + along * Math.sin(leg.rail_angle);
      const [px, py, phi] = state.pose;
      const angle = leg.cross_angle + (leg.turns ? phi : 0);
      const [dx, dy] = [Math.cos(angle), Math.sin(angle)];
      const [from, to] = this.ends[k];
      const line = this.sleeves[k];
      for (const [name, value] of [["x1", x + from * dx], ["y1", -y - from * dy], ["x2", x + to * dx], ["y2", -y - to * dy]]) line.setAttribute(name, value);
      const [u, v] = leg.pivot;
      const pivot = leg.turns ? [x, y] : [px + u * Math.cos(phi) - v * Math.sin(phi), py + u * Math.sin(phi) + v * Math.cos(phi)];
      for (const [dot, at] of [[this.carriages[k], [x, y]], [this.pivots[k], pivot]]) {
        dot.setAttribute("cx", at[0]);
        dot.setAttribute("cy", -at[1]);
      }
    });
  }
}

function points(line) {
  return line.map(([x, y]) => `${x},${-y}`).join(" ");
}

function place(group, [x, y, phi]) {
  group.setAttribute("transform", `translate(${x} ${-y}) rotate(${(-phi * 180) / Math.PI})`);
}
