// Going to a pose that is typed, or dragged on the drawing: checked on the way there while it is chosen, gone to when it is told.

import { BASE, NO_TOOL, inBase, inFrame, ofCentre, ofTool, offer } from "./frames.js";
import { obstacle } from "./service_words.js";
import { typedAngle, typedLength, unit } from "./units.js";
import { mark, onLanguage, quoted, say } from "./words.js";

export const LENGTHS = { mm: 1e-3, m: 1, cm: 1e-2, um: 1e-6, "µm": 1e-6, "μm": 1e-6, in: 0.0254 };
export const ANGLES = { "°": Math.PI / 180, deg: Math.PI / 180, rad: 1, mrad: 1e-3, "'": Math.PI / 10800, arcmin: Math.PI / 10800, '"': Math.PI / 648000, arcsec: Math.PI / 648000 };
const THOUSANDS = /^[+\-−]?[1-9]\d{0,2}[.,]\d{3}$/;
const AXES = ["x", "y", "phi"];
const AGAIN = 500; // a pose is checked again after so long where the robot has moved meanwhile [ms]
const byId = (id) => document.getElementById(id);

// A number as it was typed, with its unit, in SI; null for what is none. Point and comma are decimal marks; but the one
// that is not the language's may separate thousands before exactly three digits, as in 10,000 in English, and 10.000 in
// German. Without a unit a length is in that of the page.
export function quantity(text, units) {
  const [, digits, name] = /^\s*([+\-−]?(?:\d+[.,]?\d*|[.,]\d+))\s*([^\d\s]*)\s*$/.exec(text) ?? [];
  const known = name || (units === LENGTHS ? unit() : "°");
  if (!digits || !Object.hasOwn(units, known) || (THOUSANDS.test(digits) && !digits.includes(mark()))) return null;
  const value = Number(digits.replace(",", ".").replace("−", "-")) * units[known];
  return Number.isFinite(value) ? value : null;
}

export class Going {
  // `send` says a message to the server; `now()` is the robot, where it stands and its drawing, each null before there is one.
  // `speed()` is the share of full speed to go at.
  constructor(send, now, answer, speed) {
    this.send = send;
    this.speed = speed;
    this.now = now;
    this.answer = answer;
    this.fields = AXES.map((axis) => byId(`to-${axis}`));
    this.number = 0;
    this.from = null; // where the robot stood when that was checked, and when that was
    this.pose = null; // what is chosen, if it is a pose: of the tool, in the frame
    this.meaning = ""; // the unit, decimal mark, tool and frame of what is typed
    this.fields.forEach((field) => field.addEventListener("input", () => this.#typed()));
    byId("going").addEventListener("submit", (event) => {
      event.preventDefault();
      this.#go();
    });
    byId("here").addEventListener("click", () => this.choose(now().pose));
    for (const name of ["tool", "frame"])
      byId(name).addEventListener("change", () => (this.pose ? this.choose(this.centre) : this.#typed())); // the same place in other numbers
    onLanguage(() => {
      const { centre } = this;
      this.show();
      this.choose(centre); // the same place in the numbers of the language
    });
    const svg = byId("mechanism");
    svg.addEventListener("pointerdown", (event) => this.#grab(event));
    svg.addEventListener("pointermove", (event) => this.#drag(event));
    for (const end of ["pointerup", "pointercancel"]) svg.addEventListener(end, () => (this.grabbed = null));
  }

  // Show what there is to choose, for the robot and in the language of now.
  show() {
    const { robot } = this.now();
    if (robot) offer(byId("frame"), [["base", say("frame.base")], ...Object.keys(robot.frames).map((name) => [name, name])]);
    this.fields.slice(0, 2).forEach((field) => { field.placeholder = unit(); });
    // The same numbers may be another place, after a restart with another configuration, or in another language.
    if (this.meaning !== this.#meaning) this.fields.forEach((field) => { field.value = ""; });
    this.#typed();
  }

  // Choose where the platform's centre is to be in the base frame, as if it were typed.
  choose(centre) {
    if (!centre) return;
    const [x, y, phi] = inFrame(ofTool(centre, this.#tool), this.#frame);
    const shown = [typedLength(x), typedLength(y), typedAngle(phi)];
    this.fields.forEach((field, k) => { field.value = shown[k]; });
    this.#typed();
  }

  // The server says what is in the way; nothing where it knows of nothing.
  checked({ number, obstacle: found }) {
    if (number !== this.number || !this.pose) return;
    byId("going").dataset.may = found ? "no" : "yes";
    byId("going-says").replaceChildren(...(found ? [found.on_way ? `${say("going.on_way")} ` : "", obstacle(found)] : [say("going.free")]), this.now().robot.mapped ? ` ${say("going.uncorrected")}` : "");
    this.now().drawing?.wanted(this.centre, !found);
  }

  // Check again where the robot has moved: the way from there is another one.
  state({ pose }) {
    const at = performance.now();
    if (!this.pose || at - this.from.at < AGAIN || pose.every((value, k) => Math.abs(value - this.from.pose[k]) < 1e-6)) return;
    this.#check();
  }

  // Nobody knows whether it is still so: check again when there is a state.
  lost() {
    if (!this.pose) return;
    this.number++;
    this.from = { pose: [NaN, NaN, NaN], at: -Infinity };
    byId("going").dataset.may = "";
    byId("going-says").replaceChildren(say("bar.contact"));
    this.now().drawing?.wanted(this.centre, null);
  }

  #check() {
    this.from = { pose: this.now().pose ?? [0, 0, 0], at: performance.now() };
    this.send({ do: "check", goal: this.#goal, number: ++this.number });
  }

  get #meaning() {
    return JSON.stringify([unit(), mark(), byId("tool").value, this.#tool, byId("frame").value, this.#frame]);
  }

  get #tool() {
    return this.now().robot?.tools[byId("tool").value] ?? NO_TOOL;
  }

  get #frame() {
    return this.now().robot?.frames[byId("frame").value] ?? BASE;
  }

  get #goal() {
    const [x, y, phi] = this.pose;
    return { kind: "pose", x, y, phi, speed: this.speed(), tool: byId("tool").value || null, frame: byId("frame").value || "base" };
  }

  #typed() {
    this.meaning = this.#meaning;
    const values = this.fields.map((field, k) => quantity(field.value, k < 2 ? LENGTHS : ANGLES));
    this.fields.forEach((field, k) => field.setAttribute("aria-invalid", String(field.value !== "" && values[k] === null)));
    this.pose = values.includes(null) ? null : values;
    this.centre = this.pose && ofCentre(inBase(this.pose, this.#frame), this.#tool);
    byId("going").dataset.may = "";
    const wrong = this.fields.find((field, k) => field.value !== "" && values[k] === null);
    byId("going-says").replaceChildren(...(wrong ? [quoted(wrong.value), `: ${say("going.wrong")}`] : []));
    this.now().drawing?.wanted(this.centre, null);
    this.now().drawing?.tool(byId("tool").value ? this.#tool : null);
    if (this.pose) this.#check();
  }

  #go() {
    if (!this.pose) return this.fields.find((_, k) => quantity(this.fields[k].value, k < 2 ? LENGTHS : ANGLES) === null)?.focus();
    this.answer(say("do.pose"));
    this.send({ do: "goal", goal: this.#goal });
  }

  #grab(event) {
    const { pose, drawing, robot } = this.now();
    const from = this.centre ?? pose;
    if (event.button !== 0 || !from || !drawing || !robot?.permissions.includes("goal")) return;
    event.preventDefault();
    byId("mechanism").setPointerCapture(event.pointerId);
    const at = drawing.place(event);
    this.grabbed = { from, at, angle: angle(from, at), turned: 0 };
  }

  #drag(event) {
    if (!this.grabbed) return;
    const { from, at } = this.grabbed;
    const pointer = this.now().drawing.place(event);
    if (!event.shiftKey) return this.choose([from[0] + pointer[0] - at[0], from[1] + pointer[1] - at[1], from[2]]);
    const more = angle(from, pointer) - this.grabbed.angle; // around the other side where it passes 180°
    this.grabbed.turned += more - 2 * Math.PI * Math.round(more / (2 * Math.PI));
    this.grabbed.angle = angle(from, pointer);
    this.choose([from[0], from[1], from[2] + this.grabbed.turned]);
  }
}

// The direction of a point from a pose's place.
const angle = ([x, y], [px, py]) => Math.atan2(py - y, px - x);
