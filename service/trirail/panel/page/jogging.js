// Jogging: while a button is held, or a gamepad's shoulder, or by a step for each press; along a frame, about a tool.

import { offer, rotated } from "./frames.js";
import { Pads } from "./gamepad.js";
import { Hold } from "./hold.js";
import { DEGREE, rounded, step, unit } from "./units.js";
import { number, onLanguage, say } from "./words.js";

const STEPS = 4; // beside jogging while a button is held

const byId = (id) => document.getElementById(id);

export class Jogging {
  // `send` says a message to the server; `now()` is the robot and where it stands.
  constructor(send, now, answer, barred, stop) {
    this.now = now;
    const sign = (direction) => this.step === 0 && send({ do: "hold", velocity: this.#velocity(direction), tool: byId("tool").value || null });
    const release = () => send({ do: "release" });
    this.step = 0; // which of the robot's steps is chosen, from 1; 0: a button moves while it is held
    this.hold = new Hold(
      document.querySelectorAll(".hold"),
      sign,
      release,
      ({ axis, sign }) => {
        if (this.step === 0) return;
        const by = { x: 0, y: 0, phi: 0, [axis]: Number(sign) * (axis === "phi" ? this.#angle(this.step) * DEGREE : this.#length(this.step)) };
        answer(say("do.move"));
        send({ do: "goal", goal: { kind: "move", ...by, speed: this.speed, tool: byId("tool").value || null, frame: byId("along").value } });
      },
      (button) => barred(button.title),
    );
    const [button] = this.hold.buttons;
    this.pads = new Pads({
      sign, release, stop,
      faster: (by) => this.faster(by),
      found: () => answer(say("jog.pad")),
      unknown: () => barred(say("jog.other_pad")),
      may: () => !button.disabled && this.hold.held.size === 0,
      barred: () => barred(button.title),
    });
    byId("steps").replaceChildren(...Array.from({ length: STEPS + 1 }, (_, which) => this.#button(which)));
    byId("speed").addEventListener("input", () => this.#showSpeed());
    onLanguage(() => this.show());
    this.choose(0);
  }

  end() {
    this.hold.end();
    this.pads.end();
  }

  choose(number) {
    this.end();
    this.step = number;
    this.show();
  }

  faster(by) {
    byId("speed").value = Number(byId("speed").value) + by;
    this.#showSpeed();
  }

  // Show what there is to choose, for the robot and in the language of now.
  show() {
    const { robot } = this.now();
    if (!robot) return;
    const parts = (which) => [step(this.#length(which)), `${number(this.#angle(which), 0, 4)}°`];
    const words = (which) => (which === 0 ? say("jog.held") : say("jog.step", { length: parts(which)[0], angle: parts(which)[1] }));
    byId("step-says").textContent = words(this.step);
    [...byId("steps").children].forEach((button, which) => {
      button.setAttribute("aria-pressed", String(which === this.step));
      button.setAttribute("aria-label", words(which));
      button.textContent = which === 0 ? say("jog.hold") : parts(which).join("\n");
    });
    offer(byId("along"), [["base", say("frame.base")], ["platform", say("frame.platform")], ...Object.keys(robot.frames).map((name) => [name, name])]);
    offer(byId("tool"), [["", say("tool.centre")], ...Object.keys(robot.tools).map((name) => [name, name])]);
    this.#showSpeed();
  }

  // The share of full speed that is chosen: of jogs, and of goals.
  get speed() {
    return this.now().robot?.speeds[byId("speed").value] ?? 1;
  }

  #length(which) {
    return this.now().robot.resolution.steps[which - 1];
  }

  #angle(which) {
    return this.now().robot.resolution.angle_steps[which - 1];
  }

  #button(which) {
    const button = document.createElement("button");
    button.dataset.step = which;
    button.addEventListener("click", () => this.choose(which));
    return button;
  }

  // Along the axes of the frame that is chosen; no faster than the platform may along those of the base.
  #velocity(direction) {
    const { robot, pose } = this.now();
    const along = byId("along").value;
    const angle = along === "platform" ? (pose?.[2] ?? 0) : (robot.frames[along]?.[2] ?? 0);
    const [x, y, phi] = robot.velocity;
    const share = this.speed;
    const [u, v] = rotated([direction.x * share * x, direction.y * share * y], angle);
    const most = Math.max(1, Math.abs(u) / x, Math.abs(v) / y);
    return [u / most, v / most, direction.phi * share * phi];
  }

  #showSpeed() {
    const { robot } = this.now();
    if (!robot) return;
    const [x, y, phi] = robot.velocity;
    const linear = this.speed * Math.min(x, y) * robot.resolution.scale;
    const words = `${rounded(linear)} ${unit()}/s, ${rounded((this.speed * phi) / DEGREE)} °/s`;
    byId("speed-says").textContent = words;
    byId("speed").setAttribute("aria-valuetext", words);
  }
}
