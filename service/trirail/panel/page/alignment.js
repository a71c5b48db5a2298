// The last alignment: what each mark had to go at each look, when, and how it ended.

import { number, onLanguage, quoted, say, time } from "./words.js";

const LOOKS = 5; // columns, the newest
const KEPT = 50; // so many looks of one alignment
const WELL = ["reached", "calibrated", "checked"];

export class Alignment {
  constructor(section, button) {
    this.section = section;
    this.button = button;
    this.looks = [];
    this.user = "";
    this.time = 0;
    onLanguage(() => this.show());
    this.show();
  }

  event({ alignment: look, user, time }) {
    if (!look) return;
    const first = this.looks[0];
    if (first && (first.id !== look.id || first.purpose !== look.purpose)) this.looks = [];
    this.looks = [...this.looks, look].slice(-KEPT);
    [this.user, this.time] = [user, time];
    this.show();
  }

  show() {
    this.button.disabled = !this.looks.length;
    this.button.title = this.looks.length ? "" : say("bar.alignment");
    if (!this.looks.length) return;
    const last = this.looks.at(-1);
    const seen = this.looks.filter((look) => look.marks).slice(-LOOKS);
    const when = time(this.time);
    const corrections = this.looks.filter((look) => look.correction).length;
    const values = { end: last.end && say(`alignment.${last.end}`), seconds: number(last.seconds ?? 0, 2), corrections };
    const how = !last.end ? "alignment.under_way" : last.purpose === "alignment" ? "alignment.corrected" : "alignment.ended";
    const names = [...new Set(seen.flatMap((look) => look.marks.map((mark) => mark.name)))];
    const table = made_of("table", [
      made_of("tr", [made_of("th", [say("alignment.mark")]), ...seen.map((look) => made_of("th", [say("alignment.look", { number: look.number })]))]),
      ...names.map((name) => made_of("tr", [made_of("th", [quoted(name)]), ...seen.map((look) => made_of("td", [way(look, name)]))])),
    ]);
    const says = made_of("p", [`${when} ${say(how, values)}`, ...(last.words ? [": ", quoted(last.words)] : [])]);
    if (last.end && !WELL.includes(last.end)) says.className = "warning";
    const title = say(`alignment.${last.purpose}`);
    const whose = made_of("small", [say("alignment.of", { id: last.id, user: this.user })]);
    this.section.replaceChildren(made_of("h2", [`${title} `, whose]), says, table);
  }
}

// What a mark has to go to its target, or in a calibration where it is in the picture.
function way({ marks }, name) {
  const mark = marks.find((each) => each.name === name);
  if (!mark) return "–";
  if (!mark.to_go) return mark.pixel.map((value) => number(value, 1)).join("; ");
  const microns = Math.hypot(...mark.to_go) * 1e6;
  return `${number(microns, microns < 100 ? 2 : 1)} µm`;
}

function made_of(kind, children) {
  const element = document.createElement(kind);
  element.append(...children);
  return element;
}
