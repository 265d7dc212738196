// Runs the script of the click page without a browser: node click_probe.js PAGE, on standard input
// {"session": what the server says, "steps": [["frame", i] | ["press", x, y, shift, x to, y to] | ["row" | "clear", k]]}.
// Prints what Save sends. Only what the page asks of a browser is here.
const fs = require("fs");
const given = JSON.parse(fs.readFileSync(0, "utf8"));
const script = /<script>([\s\S]*)<\/script>/.exec(fs.readFileSync(process.argv[2], "utf8"))[1];
const drawn = [];
const pen = new Proxy({}, { get: (_, key) => (...a) => drawn.push([key, ...a]), set: () => true });

function element() {
  const self = { style: {}, children: [], classList: { toggle() {} }, value: "", textContent: "" };
  self.append = (...more) => self.children.push(...more);
  self.replaceChildren = (...all) => { self.children = all; };
  self.getContext = () => pen;
  self.setPointerCapture = () => {};
  self.getBoundingClientRect = () => ({ left: 10, top: 20, width: self.width * 2, height: self.height * 2 });
  return self;
}
const elements = {};
global.document = { getElementById: (id) => (elements[id] ??= element()), createElement: element };
global.Image = class { complete = true; set src(_) { this.onload?.(); } };
let sent = null;
global.fetch = async (where, what) => {
  if (where === "session") return { json: async () => given.session };
  sent = JSON.parse(what.body);
  return { ok: true, json: async () => ({ saved: "file" }) };
};
const at = (x, y, shift) => ({ clientX: 10 + 2 * x + 1, clientY: 20 + 2 * y + 1, shiftKey: shift, pointerId: 1 });
const steps = {
  frame: (i) => { elements.frame.value = i; elements.frame.oninput(); },
  press: (x, y, shift = false, x1 = x, y1 = y) => {
    elements.canvas.onpointerdown(at(x, y, shift));
    elements.canvas.onpointerup(at(x1, y1, shift));
  },
  row: (k) => elements.objects.children[k].onclick(),
  clear: (k) => elements.objects.children[k].children[2].onclick({ stopPropagation() {} }),
};
(async () => {
  (0, eval)(script.replace('"use strict";', ""));
  await new Promise((done) => setTimeout(done, 20));
  for (const [name, ...how] of given.steps) steps[name](...how);
  await elements.save.onclick();
  const rows = elements.objects.children.map((row) => row.children[1].textContent);
  console.log(JSON.stringify({ sent, rows, message: elements.message.textContent }));
})();
