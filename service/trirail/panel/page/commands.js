// Commands, override and lease: what may be pressed now, and by whom. What a role may not do is not there.

import { barriers } from "./barriers.js";
import { withhold } from "./focus.js";
import { number, onLanguage, say, time } from "./words.js";

const SETTING = 1000; // time after the operator's last change until the override's slider shows the robot's value again [ms]

const byId = (id) => document.getElementById(id);

export class Commands {
  // `send` says a message to the server; `now()` is the robot and its state, null without contact.
  constructor(send, now, answer, note) {
    this.now = now;
    this.users = ""; // who is connected
    this.since = null; // since when who holds the lease, as events tell
    this.set = -Infinity; // when the override's slider was last moved by the operator
    this.held = false; // whether the operator holds the override's slider, however long it stands still
    for (const button of document.querySelectorAll("[data-command]"))
      button.addEventListener("click", () => {
        const name = button.dataset.command;
        answer(say(`do.${name}`));
        send(name === "takeover" ? { do: name } : { do: "command", name });
      });
    const slider = byId("override");
    slider.addEventListener("input", () => {
      this.set = performance.now();
      showOverride(slider.value);
    });
    slider.addEventListener("change", () => send({ do: "command", name: "override", content: { percent: Number(slider.value) } }));
    slider.addEventListener("pointerdown", () => (this.held = !slider.disabled));
    const release = () => {
      if (this.held) this.set = performance.now();
      this.held = false;
    };
    for (const end of ["change", "blur"]) slider.addEventListener(end, release);
    // A mouse may be released beside the slider.
    for (const end of ["pointerup", "pointercancel"]) addEventListener(end, release, true);
    // A control that is disabled says why where it is pressed.
    document.addEventListener("pointerdown", ({ target }) => target.closest?.("button, input")?.disabled && note(target.closest("button, input").title), true);
    onLanguage(() => this.show());
  }

  event({ kind, user, time }) {
    if (kind === "lease") this.since = user ? { user, time } : null;
  }

  // Show what the role may at all.
  roles({ permissions, homes }) {
    for (const element of document.querySelectorAll("[data-needs]")) withhold(element, "hidden", !permissions.includes(element.dataset.needs));
    for (const button of document.querySelectorAll("[data-command]")) button.hidden = !permissions.includes(button.dataset.command);
    document.querySelector("[data-command=home]").hidden ||= homes.length === 0;
  }

  // Disable what cannot work now, and say why; return whether the robot may be moved. `choice` is as of barriers().
  allow(choice) {
    const { robot, state } = this.now();
    const bars = barriers(robot, state, choice);
    for (const button of document.querySelectorAll("[data-command]")) bar(button, bars[button.dataset.command]);
    for (const control of document.querySelectorAll(".hold, #poses button, #go")) bar(control, bars.goal);
    for (const id of ["override", "teach", "forget"]) bar(byId(id), bars[id]);
    for (const id of ["file-start", "follow"]) bar(byId(id), bars.follow);
    for (const control of document.querySelectorAll("[data-output]")) bar(control, bars.set_output);
    bar(byId("here"), !state ? ["bar.contact"] : this.now().pose ? null : ["bar.not_homed"]);
    return !bars.goal;
  }

  show() {
    const { robot, state } = this.now();
    const known = Boolean(state && robot);
    text(byId("people"), known && this.users ? say("people", { users: this.users }) : "");
    if (!known) {
      text(byId("lease"), "");
      return showOverride("–");
    }
    const { lease, override } = state;
    const since = lease && this.since?.user === lease ? say("lease.since", { time: time(this.since.time) }) : "";
    const words = lease ? (lease === robot.user ? "lease.mine" : "lease.held") : robot.lease === "required" ? "lease.required" : "lease.nobody";
    text(byId("lease"), say(words, { user: lease, since }));
    byId("lease").className = words === "lease.held" ? "warning" : "";
    const percent = Math.round(override * 100);
    // A value that is written while the slider is held becomes the one from which the browser sees no change on release.
    if (!this.held && performance.now() - this.set > SETTING) showOverride((byId("override").value = percent));
  }
}

// Bar a control for a reason, or let it work again and have its own title.
function bar(control, reason) {
  const title = reason ? say(...reason) : control.dataset.sayTitle ? say(control.dataset.sayTitle) : "";
  withhold(control, "disabled", Boolean(reason));
  if (control.title !== title) control.title = title;
}

// Show a percentage, or "–" where nobody knows it.
function showOverride(percent) {
  const words = `${percent === "–" ? percent : number(percent)} %`;
  text(byId("override-says"), words);
  byId("override").setAttribute("aria-valuetext", words);
}

function text(element, words) {
  if (element.textContent !== words) element.textContent = words;
}
