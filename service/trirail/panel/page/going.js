// Going to a pose that is typed, or dragged on the drawing: checked on the way there while it is chosen, gone to when it is told.

const LENGTHS = { mm: 1e-3, "": 1e-3, m: 1, cm: 1e-2, um: 1e-6, "µm": 1e-6, "μm": 1e-6, in: 0.0254 };
const ANGLES = { "°": Math.PI / 180, "": Math.PI / 180, deg: Math.PI / 180, rad: 1, mrad: 1e-3, "'": Math.PI / 10800, arcmin: Math.PI / 10800, '"': Math.PI / 648000, arcsec: Math.PI / 648000 };
const AXES = ["x", "y", "phi"];
const byId = (id) => document.getElementById(id);

// A number as it was typed, with its unit, in SI; null for what is none. A decimal comma is one.
export function quantity(text, units) {
  const found = /^\s*([+\-−]?(?:\d+[.,]?\d*|[.,]\d+))\s*([^\d\s]*)\s*$/.exec(text);
  const size = found && units[found[2]];
  return size ? Number(found[1].replace(",", ".").replace("−", "-")) * size : null;
}

export class Going {
  // `send` says a message to the server; `drawing()` is the robot's, null before there is one.
  constructor(send, drawing, answer) {
    this.send = send;
    this.drawing = drawing;
    this.answer = answer;
    this.fields = AXES.map((axis) => byId(`to-${axis}`));
    this.number = 0;
    this.pose = null; // what is chosen, if it is a pose
    this.fields.forEach((field) => field.addEventListener("input", () => this.#typed()));
    byId("going").addEventListener("submit", (event) => {
      event.preventDefault();
      this.#go();
    });
    byId("here").addEventListener("click", () => this.choose(this.now));
    const svg = byId("mechanism");
    svg.addEventListener("pointerdown", (event) => this.#grab(event));
    svg.addEventListener("pointermove", (event) => this.#drag(event));
    for (const end of ["pointerup", "pointercancel"]) svg.addEventListener(end, () => (this.grabbed = null));
  }

  // Choose a pose, as if it were typed.
  choose(pose) {
    if (!pose) return;
    const shown = [pose[0] * 1e3, pose[1] * 1e3, (pose[2] * 180) / Math.PI];
    this.fields.forEach((field, k) => { field.value = Number(shown[k].toFixed(4)); });
    this.#typed();
  }

  // The robot stands there now.
  stands(pose) {
    this.now = pose;
  }

  // The server says what is in the way; nothing where it knows of nothing.
  checked({ number, why }) {
    if (number !== this.number || !this.pose) return;
    byId("going").dataset.may = why ? "no" : "yes";
    byId("going-says").textContent = why || byId("going-says").dataset.free;
    this.drawing()?.wanted(this.pose, !why);
  }

  #typed() {
    const values = this.fields.map((field, k) => quantity(field.value, k < 2 ? LENGTHS : ANGLES));
    this.fields.forEach((field, k) => field.setAttribute("aria-invalid", String(field.value !== "" && values[k] === null)));
    this.pose = values.includes(null) ? null : values;
    byId("going").dataset.may = "";
    const wrong = this.fields.find((field, k) => field.value !== "" && values[k] === null);
    byId("going-says").textContent = wrong ? `${wrong.value}: ${byId("going-says").dataset.wrong}` : "";
    this.drawing()?.wanted(this.pose, null);
    if (this.pose) this.send({ do: "check", pose: this.pose, number: ++this.number });
  }

  #go() {
    if (!this.pose) return this.fields.find((_, k) => quantity(this.fields[k].value, k < 2 ? LENGTHS : ANGLES) === null)?.focus();
    this.answer("go there …");
    this.send({ do: "pose", pose: this.pose });
  }

  #grab(event) {
    const from = this.pose ?? this.now;
    if (event.button !== 0 || !from || !this.drawing()) return;
    event.preventDefault();
    byId("mechanism").setPointerCapture(event.pointerId);
    this.grabbed = { from, at: this.drawing().place(event) };
  }

  #drag(event) {
    if (!this.grabbed) return;
    const { from, at } = this.grabbed;
    const [x, y] = this.drawing().place(event);
    if (event.shiftKey) this.choose([from[0], from[1], from[2] + Math.atan2(y - from[1], x - from[0]) - Math.atan2(at[1] - from[1], at[0] - from[0])]);
    else this.choose([from[0] + x - at[0], from[1] + y - at[1], from[2]]);
  }
}
