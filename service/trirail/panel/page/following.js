// Following a path in a file: sent to the server once, in parts; checked and drawn when it is chosen, followed when it is
// told, and how far it is meanwhile.

import { refusal } from "./service_words.js";
import { rounded } from "./units.js";
import { number, onLanguage, say } from "./words.js";

const PART = 8192; // so much of a file is sent before the server's answer [bytes]: a STOP waits for no more

const byId = (id) => document.getElementById(id);

export class Following {
  // `send` says a message to the server, `sendPart` bytes of the file; `now()` has the robot and its drawing; `allow`
  // looks anew what may be pressed.
  constructor(send, sendPart, now, allow, answer, speed) {
    this.send = send;
    this.sendPart = sendPart;
    this.now = now;
    this.allow = allow;
    this.number = 0; // of the last file, or check
    this.file = null; // number, name and bytes of what is chosen
    this.complete = false; // whether the server has it
    this.found = null; // what the server says of it
    this.asked = null; // the file that was last told to be followed
    this.goal = null; // the last goal of a file: id and file
    this.under_way = ""; // how far that is, in words, while it is what the robot does
    this.contact = false; // with the robot
    this.trouble = []; // why a file could not be chosen, as of say()
    byId("choose-file").addEventListener("click", () => byId("file").click());
    byId("file").addEventListener("change", () => this.#choose(byId("file").files[0]));
    byId("stretch").addEventListener("change", () => this.#check());
    byId("stretch").addEventListener("keydown", (event) => {
      if (event.key !== "Enter") return;
      event.preventDefault(); // Space is STOP, and Enter would follow
      byId("stretch").click();
    });
    byId("file-start").addEventListener("click", () => {
      answer(say("do.pose"));
      const [x, y, phi] = this.found.line[0];
      send({ do: "goal", goal: { kind: "pose", x, y, phi, speed: speed() } });
    });
    byId("following").addEventListener("submit", (event) => {
      event.preventDefault();
      this.asked = this.file;
      answer(say("do.follow", this.file));
      send({ do: "follow", file: this.file.number, stretch: byId("stretch").checked });
    });
    onLanguage(() => this.#show());
  }

  // What bars its buttons, as of barriers().
  get choice() {
    if (!this.file) return "none";
    return this.may ? "" : this.found ? "barred" : "checking";
  }

  // Whether there is a path that can be followed.
  get may() {
    return this.found !== null && !this.found.why;
  }

  // Send the file to a server that does not have it.
  upload() {
    if (!this.file) return;
    const { number: file, name, bytes } = this.file;
    this.complete = false;
    this.found = null;
    this.send({ do: "upload", file, name, size: bytes.length });
    this.#show();
  }

  // The server has so much of the file.
  received({ file, size }) {
    if (file !== this.file?.number) return;
    const { bytes } = this.file;
    if (size < bytes.length) return this.sendPart(bytes.subarray(size, size + PART));
    this.complete = true;
    this.#check();
  }

  // The server says what the file comes to.
  checked({ number, found }) {
    if (number !== this.number) return;
    this.found = { why: "", line: [], slowed: 1, ...found };
    this.#show();
  }

  accepted(id) {
    this.goal = { id, file: this.asked };
  }

  // How far the file is that the robot follows; the words of the one that is chosen again when it has ended.
  state({ goal }) {
    const runs = goal !== null && goal.id === this.goal?.id;
    byId("file-progress").style.visibility = runs ? "" : "hidden";
    if (runs) byId("file-progress").value = goal.progress;
    this.under_way = runs ? say("file.under_way", { ...this.goal.file, percent: number(goal.progress * 100), left: number(goal.remaining, 1) }) : "";
    if (this.contact) return this.#say();
    this.contact = true;
    this.#show();
  }

  // Nobody knows how far it is, nor whether a file can be followed.
  lost() {
    byId("file-progress").style.visibility = "hidden";
    this.under_way = "";
    this.contact = false;
    this.#show();
  }

  // Check it for another robot, or other limits.
  robot() {
    this.#check();
    this.draw();
  }

  // Its drawing once more, on a robot that is drawn anew.
  draw() {
    this.now().drawing?.path(this.found?.line ?? [], this.contact ? this.may : null);
  }

  async #choose(file) {
    byId("file").value = ""; // so that the same one can be chosen again, when it has been changed
    if (!file) return;
    this.file = this.found = null;
    this.trouble = [];
    const number = ++this.number;
    const refuse = (key) => {
      this.trouble = [key, file];
      this.#show();
    };
    if (file.size > this.now().robot.largest_file) return refuse("file.large");
    const content = await file.arrayBuffer().catch(() => null); // of a file that has been deleted, there is none
    if (number !== this.number) return; // another one has been chosen meanwhile
    if (!content) return refuse("file.unreadable");
    this.file = { number, name: file.name, bytes: new Uint8Array(content) };
    this.upload();
  }

  #check() {
    if (!this.file || !this.complete) return;
    this.found = null;
    this.send({ do: "check path", file: this.file.number, stretch: byId("stretch").checked, number: ++this.number });
    this.#show();
  }

  #show() {
    this.draw();
    this.allow();
    byId("following").dataset.may = this.contact && this.found ? (this.may ? "yes" : "no") : "";
    this.#say();
  }

  // The words for the file that is under way, and for the one that is chosen, if it is another.
  #say() {
    const found = this.under_way && this.goal.file === this.file ? [] : this.#found();
    const words = [this.under_way, this.under_way && found.length ? "\n" : "", ...found];
    if (byId("file-says").textContent !== words.map((each) => each.textContent ?? each).join("")) byId("file-says").replaceChildren(...words);
  }

  // The words for the file that is chosen.
  #found() {
    const { file, found } = this;
    if (this.trouble.length) return [say(...this.trouble)];
    if (!file) return [];
    if (!this.contact) return [say("file.barred", file), " ", say("bar.contact")];
    const values = { name: file.name, duration: rounded(found?.duration ?? 0), slowed: rounded(found?.slowed ?? 1) };
    const key = !found ? "checking" : found.why ? "barred" : found.slowed > 1 ? "slowed" : "free";
    const note = found && this.now().robot.mapped ? [` ${say("going.uncorrected")}`] : [];
    return [say(`file.${key}`, values), ...(found?.why ? [" ", refusal({ ...found, message: found.why })] : []), ...note];
  }
}
