// Sliders under a finger: the browser sets one when the finger comes down, though the finger may be about to scroll the page.
// A slider takes a value only when the finger moves along it, or has tapped it; one that scrolls leaves it as it was.

for (const slider of document.querySelectorAll("input[type=range]")) {
  let before = ""; // the value when the pointer came down
  let tapped = null; // the value at a finger that has not moved yet; null for none
  const take = (value, ...kinds) => {
    if (slider.value === value) return;
    slider.value = value;
    for (const kind of kinds) slider.dispatchEvent(new Event(kind));
  };
  slider.addEventListener("pointerdown", ({ pointerType }) => {
    before = slider.value;
    tapped = pointerType === "touch" ? before : null;
  });
  slider.addEventListener("input", (event) => {
    if (tapped === null) return;
    tapped = slider.value;
    slider.value = before;
    event.stopImmediatePropagation();
  });
  slider.addEventListener("pointermove", () => (tapped = null));
  slider.addEventListener("pointerup", () => {
    const value = tapped;
    tapped = null;
    if (value !== null) take(value, "input", "change");
  });
  slider.addEventListener("pointercancel", () => {
    tapped = null;
    take(before, "input");
  });
}
