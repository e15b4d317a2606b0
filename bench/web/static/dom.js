// Elements made of text only: no name from the bench is ever read as markup.

export const by = (id) => document.getElementById(id);

export function set(target, text) {
  const element = typeof target === "string" ? by(target) : target;
  const value = text ?? "–";
  if (element.textContent !== value) element.textContent = value;
}

export function make(name, attributes = {}, ...children) {
  return fill(document.createElement(name), attributes, children);
}

export function draw(name, attributes = {}, ...children) {
  return fill(document.createElementNS("http://www.w3.org/2000/svg", name), attributes, children);
}

function fill(element, attributes, children) {
  for (const [key, value] of Object.entries(attributes)) {
    if (key === "on") for (const [event, action] of Object.entries(value)) element.addEventListener(event, action);
    else if (value !== null && value !== false) element.setAttribute(key, value === true ? "" : String(value));
  }
  element.append(...children.map((child) => (typeof child === "object" ? child : String(child))));
  return element;
}

// Replace the rows of a list only where a text has changed, so that a screen reader is not disturbed.
export function rows(target, texts, makeRow) {
  const list = typeof target === "string" ? by(target) : target;
  const key = JSON.stringify(texts);
  if (list.shown === key) return;
  list.shown = key;
  list.replaceChildren(...texts.map(makeRow));
}

export const pair = ([name, value]) => make("div", {}, make("dt", {}, name), make("dd", {}, value));
