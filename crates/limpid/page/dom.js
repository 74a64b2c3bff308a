// Elements and numbers. Text goes in as text: nothing that a file says becomes markup.

const $ = (id) => document.getElementById(id);

/** An element with attributes, and children that are elements or text. */
function el(tag, attributes = {}, ...children) {
  return filled(document.createElement(tag), attributes, children);
}

/** The same in a drawing. */
function svg(tag, attributes = {}, ...children) {
  return filled(document.createElementNS("http://www.w3.org/2000/svg", tag), attributes, children);
}

function filled(element, attributes, children) {
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  element.append(...children.map((child) => (child instanceof Node ? child : String(child))));
  return element;
}

const isNumber = (value) => typeof value === "number" && Number.isFinite(value);

/** A number with so many decimals, or a dash for what is none. */
const decimals = (value, digits) => (isNumber(value) ? value.toFixed(digits) : "–");

/** A whole number with separators. */
const whole = (value) => (isNumber(value) ? Math.round(value).toLocaleString("en") : "–");

const clamp = (value, low, high) => Math.min(Math.max(value, low), high);

/** Seconds as people say them. */
function duration(seconds) {
  if (!isNumber(seconds)) return "–";
  if (seconds < 120) return `${Math.round(seconds)} s`;
  if (seconds < 7200) return `${Math.round(seconds / 60)} min`;
  return `${(seconds / 3600).toFixed(1)} h`;
}

/** Brings a part of the page into view. */
function bringUp(id) {
  $(id).scrollIntoView({ behavior: prefersStill() ? "auto" : "smooth" });
}

const prefersStill = () => matchMedia("(prefers-reduced-motion: reduce)").matches;

/** Whether a key is meant for the browser, or for the field, button or table that has the focus. */
function isForOthers({ ctrlKey, metaKey, altKey, target, key }) {
  if (ctrlKey || metaKey || altKey) return true;
  return Boolean(target.closest("input, select, summary, a, .scroll") || (target.closest("button") && (key === " " || key === "Enter")));
}
