/** Elements without a framework: made in one call, filled with nodes and texts, never with markup. */

import { at } from "./root.js";

const SVG = "http://www.w3.org/2000/svg";
const AS_ATTRIBUTE = /^(aria-|data-|role$|for$|list$|form$|colspan$|rowspan$|width$|height$)/;

/**
 * An element. props: class, dataset, style {property: value}, on* (listeners), aria-* and other attributes, and any
 * property of the element. A prop that is null, undefined or (for attributes) false is left out.
 */
export function h(tag, props, ...children) {
  const element = document.createElement(tag);
  for (const [key, value] of Object.entries(props ?? {})) setProp(element, key, value);
  append(element, children);
  return element;
}

/** An SVG element; on* props are listeners, everything else an attribute. */
export function svg(tag, attributes, ...children) {
  const element = document.createElementNS(SVG, tag);
  for (const [key, value] of Object.entries(attributes ?? {})) {
    if (key.startsWith("on")) element.addEventListener(key.slice(2).toLowerCase(), value);
    else if (value !== null && value !== undefined && value !== false) element.setAttribute(key, value);
  }
  append(element, children);
  return element;
}

/** Replace all children by new ones. */
export function replace(node, ...children) {
  node.replaceChildren();
  append(node, children);
  return node;
}

/** Write a text only if it differs, to leave screen readers and selections alone. */
export function write(node, text) {
  if (node.textContent !== text) node.textContent = text;
  return node;
}

let numbers = 0;

/** An id that nothing else on the page has. */
export function freshId(word = "e") {
  numbers += 1;
  return `${word}-${numbers}`;
}

function setProp(element, key, value) {
  if (value === null || value === undefined) return;
  if (key === "class") element.className = value;
  else if (key === "dataset") Object.assign(element.dataset, value);
  else if (key === "style") for (const [name, own] of Object.entries(value)) element.style.setProperty(name, own);
  else if (key.startsWith("on")) element.addEventListener(key.slice(2).toLowerCase(), value);
  else if (key in element && !AS_ATTRIBUTE.test(key)) element[key] = value;
  else if (value !== false || key.startsWith("aria-"))
    element.setAttribute(key, value === true && !key.startsWith("aria-") ? "" : value);
}

function append(element, children) {
  for (const child of children.flat(Infinity)) {
    if (child !== null && child !== undefined && child !== false) element.append(child);
  }
}

const sheets = new Map();

/** Loads a style sheet of this server once; resolves when it is applied. */
export function sheet(href) {
  if (!sheets.has(href)) {
    sheets.set(
      href,
      new Promise((done) => {
        document.head.append(h("link", { rel: "stylesheet", href: at(href), onload: done, onerror: done }));
      }),
    );
  }
  return sheets.get(href);
}

/** Calls `work` when the node comes into view, and by `again()` once more if it is; {again(), seen(), end()}.
 * @param {(seen: boolean) => void} onChange */
export function whenSeen(node, work, onChange = () => {}) {
  let seen = false;
  const watch = new IntersectionObserver((entries) => {
    seen = entries.at(-1).isIntersecting;
    onChange(seen);
    if (seen) work();
  }, { rootMargin: "200px" });
  watch.observe(node);
  return { again: () => seen && work(), seen: () => seen, end: () => watch.disconnect() };
}
