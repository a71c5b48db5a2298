// Jogging: while a button is held, or by a step for each press; along the axes of a frame, about a tool.

import { offer, rotated } from "./frames.js";
import { Hold } from "./hold.js";
import { onLanguage, say } from "./words.js";

const STEPS = [null, 0.01, 0.1, 1, 10]; // what a press of a jog button moves [mm]; null: while it is held
const TURNS = [null, 0.01, 0.1, 1, 1]; // the same about φ [°]

const byId = (id) => document.getElementById(id);

export class Jogging {
  // `send` says a message to the server; `now()` is the robot, where it stands and the stamp of the newest state drawn.
  constructor(send, now, answer) {
    this.now = now;
    this.step = 0; // which of STEPS is chosen
    this.hold = new Hold(
      document.querySelectorAll(".hold"),
      (direction) => STEPS[this.step] === null && send({ do: "hold", velocity: this.#velocity(direction), seen: now().seen, tool: byId("tool").value || null }),
      () => send({ do: "release" }),
      ({ axis, sign }) => {
        if (STEPS[this.step] === null) return;
        const by = { x: 0, y: 0, phi: 0, [axis]: Number(sign) * (axis === "phi" ? (TURNS[this.step] * Math.PI) / 180 : STEPS[this.step] / 1e3) };
        answer(say("answer.asked", { what: say("do.step") }));
        send({ do: "step", by: [by.x, by.y, by.phi], seen: now().seen, tool: byId("tool").value || null, frame: byId("along").value });
      },
    );
    byId("steps").replaceChildren(...STEPS.map((_, number) => this.#button(number)));
    byId("speed").addEventListener("input", () => this.#showSpeed());
    onLanguage(() => this.show());
    this.choose(0);
  }

  end() {
    this.hold.end();
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
    const words = (number) => (STEPS[number] === null ? say("jog.held") : say("jog.step", { length: STEPS[number], angle: TURNS[number] }));
    byId("step-says").textContent = words(this.step);
    [...byId("steps").children].forEach((button, number) => {
      button.setAttribute("aria-pressed", String(number === this.step));
      button.setAttribute("aria-label", words(number));
      button.textContent = STEPS[number] ?? say("jog.hold");
    });
    const { robot } = this.now();
    if (!robot) return;
    offer(byId("along"), [["base", say("frame.base")], ["platform", say("frame.platform")], ...Object.keys(robot.frames).map((name) => [name, name])]);
    offer(byId("tool"), [["", say("tool.centre")], ...Object.keys(robot.tools).map((name) => [name, name])]);
    this.#showSpeed();
  }

  #button(number) {
    const button = document.createElement("button");
    button.dataset.step = number;
    button.addEventListener("click", () => this.choose(number));
    return button;
  }

  // Along the axes of the frame that is chosen; no faster than the platform may along those of the base.
  #velocity(direction) {
    const { robot, pose } = this.now();
    const along = byId("along").value;
    const angle = along === "platform" ? pose[2] : (robot.frames[along]?.[2] ?? 0);
    const [x, y, phi] = robot.velocity;
    const share = robot.speeds[byId("speed").value];
    const [u, v] = rotated([direction.x * share * x, direction.y * share * y], angle);
    const most = Math.max(1, Math.abs(u) / x, Math.abs(v) / y);
    return [u / most, v / most, direction.phi * share * phi];
  }

  #showSpeed() {
    const { robot } = this.now();
    if (!robot) return;
    const share = robot.speeds[byId("speed").value];
    const [x, y, phi] = robot.velocity;
    const linear = share * Math.min(x, y) * 1e3;
    const angular = (share * phi * 180) / Math.PI;
    const words = `${Number(linear.toPrecision(3))} mm/s, ${Number(angular.toPrecision(3))} °/s`;
    byId("speed-says").textContent = words;
    byId("speed").setAttribute("aria-valuetext", words);
  }
}
