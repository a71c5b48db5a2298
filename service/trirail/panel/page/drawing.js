// The mechanism as an SVG, in metres, y upwards: fixed parts once, the others where a state has them.

const SVG = "http://www.w3.org/2000/svg";

export class Drawing {
  constructor(svg, robot) {
    const { parts, legs, colours } = robot;
    this.legs = legs;
    this.sleeve = parts.sleeve;
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
    this.goal = add("g", "");
    lines(parts.outline, "goal", this.goal);
    this.platform = add("g", "");
    lines(parts.outline, "platform", this.platform);
    lines(parts.arms, "arm", this.platform);
    lines(parts.edge_stops, "stop", this.platform);
    const centre = add("circle", "centre", this.platform);
    centre.setAttribute("r", 0.012 * (high[0] - low[0]));
    this.sleeves = legs.map((_, k) => add("line", "sleeve", svg, colours.sliders[k]));
    parts.names.forEach(([x, y], k) => {
      const name = add("text", "");
      name.style.fill = colours.sliders[k];
      name.setAttribute("x", x);
      name.setAttribute("y", -y);
      name.textContent = "ABC"[k];
    });
  }

  show(state) {
    place(this.platform, state.pose);
    const target = state.goal?.target;
    this.goal.style.display = target ? "" : "none";
    if (target) place(this.goal, target);
    this.legs.forEach((leg, k) => {
      const along = leg.home + state.sliders.position[k];
      const x = leg.anchor[0] + along * Math.cos(leg.rail_angle);
      const y = leg.anchor[1] + along * Math.sin(leg.rail_angle);
      const dx = this.sleeve * Math.cos(state.pose[2] + leg.edge_angle);
      const dy = this.sleeve * Math.sin(state.pose[2] + leg.edge_angle);
      const line = this.sleeves[k];
      for (const [name, value] of [["x1", x - dx], ["y1", dy - y], ["x2", x + dx], ["y2", -y - dy]]) line.setAttribute(name, value);
    });
  }
}

function points(line) {
  return line.map(([x, y]) => `${x},${-y}`).join(" ");
}

function place(group, [x, y, phi]) {
  group.setAttribute("transform", `translate(${x} ${-y}) rotate(${(-phi * 180) / Math.PI})`);
}
