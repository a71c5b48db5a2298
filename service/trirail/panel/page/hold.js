// The dead man: what is held down, by finger, mouse or key, as one velocity; said again and again while it is held.
//
// All of this runs on the page's own thread, so that a page that hangs says nothing and the robot brakes. A worker
// would go on while the page hangs.

import { owner } from "./focus.js";

export const EVERY = 50; // between two signs of the hand [ms]; the service brakes 200 ms after the last
export const HUNG = 180; // a sign so late comes from a page that has hung: what it held counts no more [ms]

const JOGS = "html, body, button"; // keys jog where one of these has the focus; all else has other uses for them, as to scroll
const KEYS = {
  ArrowRight: ["x", 1], ArrowLeft: ["x", -1], ArrowUp: ["y", 1], ArrowDown: ["y", -1], a: ["phi", 1], d: ["phi", -1],
};

// Whether a pointer is in the rectangle of an element, whatever lies above it.
export function contains(element, { clientX, clientY }) {
  const { left, right, top, bottom } = element.getBoundingClientRect();
  return clientX >= left && clientX <= right && clientY >= top && clientY <= bottom;
}

export class Hold {
  // `sign(direction)` is told {x, y, phi}, each -1, 0 or 1, while something is held; `release()` when nothing is any more;
  // `press({axis, sign})` when a button is pressed, once; `barred(button)` when the key of one that is disabled is.
  constructor(buttons, sign, release, press, barred) {
    this.sign = sign;
    this.release = release;
    this.press = press;
    this.barred = barred;
    this.held = new Map(); // which finger or key holds which button
    this.timer = null;
    this.last = 0;
    this.buttons = [...buttons];
    for (const button of this.buttons) this.#listen(button);
    addEventListener("keydown", (event) => this.#key(event));
    addEventListener("keyup", (event) => this.#up(`key ${event.code}`));
    for (const gone of ["blur", "pagehide", "freeze", "dragstart"]) addEventListener(gone, () => this.end());
    // While a list or a menu is open, the browser gives it every key, also the end of one that was held before.
    addEventListener("pointerdown", (event) => event.target.closest("select") && this.end(), true);
    addEventListener("contextmenu", (event) => event.defaultPrevented || this.end());
    document.addEventListener("visibilitychange", () => document.hidden && this.end());
  }

  // End every hold; each button must be let go and pressed again.
  end() {
    if (this.held.size === 0) return;
    for (const button of this.held.values()) button.classList.remove("held");
    this.held.clear();
    clearInterval(this.timer);
    this.release();
  }

  #listen(button) {
    button.addEventListener("pointerdown", (event) => {
      if (event.button !== 0) return;
      event.preventDefault();
      button.setPointerCapture(event.pointerId);
      this.#down(`pointer ${event.pointerId}`, button);
    });
    // It is captured so that its end is told wherever it is; off the button it holds no more, as a finger.
    button.addEventListener("pointermove", (event) => {
      if (!(event.buttons & 1) || !contains(button, event)) this.#up(`pointer ${event.pointerId}`);
    });
    for (const up of ["pointerup", "pointercancel", "lostpointercapture"])
      button.addEventListener(up, (event) => this.#up(`pointer ${event.pointerId}`));
    button.addEventListener("touchcancel", () => this.end());
    button.addEventListener("contextmenu", (event) => event.preventDefault());
    button.addEventListener("click", (event) => event.detail === 0 && this.press(button.dataset)); // by a screen reader, which cannot hold
  }

  #key(event) {
    // The key's end may be told to nobody; a key in a list may open it.
    if (event.ctrlKey || event.metaKey || event.altKey) return this.end();
    const axis = KEYS[event.key.length === 1 ? event.key.toLowerCase() : event.key];
    if (event.target.closest("select")) {
      // In a list that is closed the letter would choose another entry, by its first letter.
      if (axis && event.key.length === 1 && event.target.matches("select")) event.preventDefault();
      return this.end();
    }
    const onButton = event.key === "Enter" && this.buttons.includes(event.target);
    if (!onButton && (!axis || !event.target.matches(JOGS))) return;
    event.preventDefault();
    if (event.repeat) return;
    const lost = owner();
    if (lost && !lost.matches(JOGS)) return this.barred(lost);
    const [name, sign] = axis ?? [];
    const matching = (each) => each.dataset.axis === name && Number(each.dataset.sign) === sign;
    this.#down(`key ${event.code}`, onButton ? event.target : this.buttons.find(matching));
  }

  #down(by, button) {
    if (button.disabled) return this.barred(button); // as where the role does not allow it
    this.held.set(by, button);
    button.classList.add("held");
    this.press(button.dataset);
    this.#say();
    clearInterval(this.timer);
    this.last = performance.now();
    this.timer = setInterval(() => this.#again(), EVERY);
  }

  #up(by) {
    const button = this.held.get(by);
    if (!button) return;
    if (this.held.size === 1) return this.end();
    this.held.delete(by);
    if (![...this.held.values()].includes(button)) button.classList.remove("held");
    this.#say();
  }

  #again() {
    const now = performance.now();
    if (now - this.last > HUNG) return this.end();
    this.last = now;
    this.#say();
  }

  #say() {
    const direction = { x: 0, y: 0, phi: 0 };
    for (const button of new Set(this.held.values())) direction[button.dataset.axis] += Number(button.dataset.sign);
    if (direction.x || direction.y || direction.phi) this.sign(direction);
    else this.end(); // opposite buttons at once
  }
}
