// The live view's page without a browser: stand-ins for what its script asks of one. A test appends the page's
// script and what it does with it (tests/test_web_page.py).
"use strict";
const written = [];
const write = text => { written.push(text); };
const brush = new Proxy({}, { get: (_, name) => (name === "fillText" ? write : () => {}), set: () => true }); // draws nothing
const elements = {}, listeners = {};
function element() {
  return {
    hidden: false, textContent: "", className: "", tagName: "DIV", dataset: {}, style: {}, attributes: {}, children: [],
    clientWidth: 600, clientHeight: 260,
    setAttribute(name, value) { this.attributes[name] = value; },
    append(...more) { this.children.push(...more); },
    replaceChildren(...all) { this.children = all; },
    getContext: () => brush,
    get text() { return this.textContent + this.children.map(child => child.text).join(" "); },
  };
}
globalThis.document = {
  documentElement: element(),
  getElementById: id => elements[id] ??= element(),
  createElement: element,
  querySelectorAll: () => ["curve", "torqueplot", "stiffnessplot", "residualplot"].map(document.getElementById),
};
globalThis.getComputedStyle = () => ({ getPropertyValue: () => "#000" });
globalThis.devicePixelRatio = 1;
globalThis.innerWidth = 1200;
globalThis.innerHeight = 900;
globalThis.addEventListener = (name, listener) => { listeners[name] = listener; };
globalThis.EventSource = class { close() {} };
const press = key => listeners.keydown({ key, target: { tagName: "BODY" }, preventDefault() {} });
const hover = (id, x, y) => document.getElementById(id).onmousemove({ offsetX: x, offsetY: y, clientX: x, clientY: y });
const shown = id => document.getElementById(id).text;
