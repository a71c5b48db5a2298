// The focus of a control that the page disables or hides: the browser takes it away, and the next key would mean something
// else. The control has it again when it works again, unless the operator has put it elsewhere meanwhile.

let lost = null; // the control that had the focus

for (const chosen of ["focusin", "pointerdown"]) addEventListener(chosen, () => { lost = null; }, true);

// The control to which keys still belong, though it has lost the focus; null for none.
export const owner = () => lost;

// Set the `property` "disabled" or "hidden" of an element.
export function withhold(element, property, value) {
  if (element[property] === value) return;
  const focused = document.activeElement;
  if (value && element.contains(focused)) lost = focused.closest("select") ?? focused; // it may be on an option
  element[property] = value;
  if (!value && element.contains(lost)) lost.focus({ preventScroll: true });
}
