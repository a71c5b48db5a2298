// Gamepads of the browser's: the sticks of each move the robot while a shoulder button of the same one is held.
//
// They have the rules of hold.js, whose page's thread they share: a page that hangs, is hidden or has no focus says
// nothing, and the robot brakes. Buttons and sticks are those of the standard mapping,
// https://w3c.github.io/gamepad/#remapping; of a pad with another mapping nobody knows which button is which.

import { EVERY, HUNG } from "./hold.js";

const [EAST, SHOULDERS, UP, DOWN] = [1, [4, 5], 12, 13];
const DEAD = 0.15; // share of a stick's way in which it counts as let go: no stick comes back to its middle exactly
// A pad that has said nothing for so long is taken for gone until it says something [ms]: of a wireless one whose link
// is lost the system keeps the last state, for seconds. A stick in a hand is never still, but at its end.
const QUIET = 2000;

const known = (pad) => pad?.connected && pad.mapping === "standard";

export class Pads {
  // `sign(direction)` is told {x, y, phi}, -1 to 1 each, while a pad moves the robot; `release()` when it does no more;
  // `stop()` and `faster(by)` when their buttons are pressed; `found()` when a pad is there, `unknown()` when one is there
  // of which nothing works; `may()` is whether a pad may move the robot, and `barred()` is called when a shoulder button
  // is pressed though it may not.
  constructor({ found, unknown, may, ...acts }) {
    this.pads = new Map(); // by their index at the browser
    const others = (pad) => [...this.pads.values()].filter((each) => each !== pad);
    this.acts = { ...acts, may: (pad) => may() && !others(pad).some(({ moves }) => moves) };
    this.last = 0;
    addEventListener("gamepadconnected", ({ gamepad }) => {
      clearInterval(this.timer);
      this.last = performance.now();
      this.timer = setInterval(() => this.#look(), EVERY);
      if (known(gamepad)) found();
      else unknown();
    });
    for (const gone of ["blur", "pagehide", "freeze", "gamepaddisconnected"]) addEventListener(gone, () => this.end());
    document.addEventListener("visibilitychange", () => document.hidden && this.end());
  }

  // End the jog; a shoulder button must be let go and pressed again.
  end() {
    for (const pad of this.pads.values()) pad.end();
  }

  #look() {
    const now = performance.now();
    const late = now - this.last > HUNG;
    this.last = now;
    const there = [...navigator.getGamepads()].filter(known);
    for (const [index, pad] of this.pads) {
      if (there.some((each) => each.index === index)) continue;
      pad.end();
      this.pads.delete(index);
    }
    for (const { index } of there) if (!this.pads.has(index)) this.pads.set(index, new Pad(this.acts));
    for (const each of there) this.pads.get(each.index).stops(each);
    for (const each of there) this.pads.get(each.index).look(each, now, late);
  }
}

// One gamepad.
class Pad {
  constructor(acts) {
    this.acts = acts;
    this.moves = false; // whether it moves the robot
    this.armed = false; // whether a shoulder button counts: only one that is pressed after the last end
    this.pressed = new Set(); // which buttons are
  }

  end() {
    this.armed = false;
    this.#rest();
  }

  stops(pad) {
    if (this.#presses(pad, EAST)) this.acts.stop();
  }

  look(pad, now, late) {
    if (late || document.hidden || !document.hasFocus()) return this.end();
    if (this.#presses(pad, UP)) this.acts.faster(1);
    if (this.#presses(pad, DOWN)) this.acts.faster(-1);
    const begins = SHOULDERS.map((each) => this.#presses(pad, each)).includes(true);
    if (!SHOULDERS.some((each) => this.pressed.has(each))) {
      this.#rest();
      this.armed = true;
    } else if (!this.acts.may(this)) {
      if (begins) this.acts.barred();
      this.end();
    } else if (this.armed) {
      this.#move(pad, now);
    }
  }

  #presses(pad, button) {
    const before = this.pressed.has(button);
    const pressed = Boolean(pad.buttons[button]?.pressed);
    this.pressed[pressed ? "add" : "delete"](button);
    return pressed && !before;
  }

  // Right is x, away from the hand is y; the right stick to the left is phi, counterclockwise.
  #move(pad, now) {
    const [x, y, phi] = now - pad.timestamp > QUIET ? [0, 0, 0] : pad.axes.map(share);
    if (!x && !y && !phi) return this.#rest();
    this.moves = true;
    this.acts.sign({ x, y: -y, phi: -phi });
  }

  #rest() {
    if (!this.moves) return;
    this.moves = false;
    this.acts.release();
  }
}

// How far a stick is from its middle, -1 to 1, but for the dead part of its way.
function share(at) {
  return Math.sign(at) * Math.min(Math.max(0, Math.abs(at) - DEAD) / (1 - DEAD), 1);
}
