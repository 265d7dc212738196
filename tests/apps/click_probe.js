// Runs the script of the click page without a browser: node click_probe.js PAGE, on standard input
// {"session": what the server says, "again": what it does not take, "steps": [["frame", i] | ["press", x, y, shift, x to, y to] | ["zoom", x, y] |
// ["tool", paint or erase, radius] | ["stroke", [x, y], ...] | ["row" | "clear" | "remove", k] | ["rename", k, name] | ["undo" | "save" | "finish"]]}.
// Prints what Save sends, and what was asked for masks. Only what the page asks of a browser is here.
const fs = require("fs");
const given = JSON.parse(fs.readFileSync(0, "utf8"));
const script = /<script>([\s\S]*)<\/script>/.exec(fs.readFileSync(process.argv[2], "utf8"))[1];
const drawn = [];
const pen = new Proxy({}, { get: (_, key) => (...a) => drawn.push([key, ...a]), set: () => true });

function element() {
  const self = { style: {}, children: [], classList: { toggle() {} }, value: "", textContent: "", checked: false };
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
global.window = { prompt: () => renamed };
let sent = null, renamed = null;
const asked = [];
document.getElementById("masks").checked = true;
global.fetch = async (where, what) => {
  if (where === "session") return { json: async () => given.session };
  const content = JSON.parse(what.body);
  if (where === "masks") {
    asked.push(content.objects);
    const { width, height } = given.session;
    const square = [height + 1, 8, (width - 1) * height - 9]; // in its second column
    const masks = Object.fromEntries(content.objects.map(({ name }) => [name, square]));
    return { ok: true, json: async () => ({ masks, doubts: ["is it a table?"] }) };
  }
  sent = content;
  return { ok: true, json: async () => ({ saved: "file", again: given.again ?? "" }) };
};
const at = (x, y, shift) => (
  { clientX: 10 + 2 * x + 1, clientY: 20 + 2 * y + 1, shiftKey: shift, pointerId: 1, button: 0, preventDefault() {} }
);
const own = (k, what) => elements.objects.children[k].children[what].onclick({ stopPropagation() {} });
const steps = {
  frame: (i) => { elements.frame.value = i; elements.frame.oninput(); },
  press: (x, y, shift = false, x1 = x, y1 = y) => {
    elements.canvas.onpointerdown(at(x, y, shift));
    elements.canvas.onpointerup(at(x1, y1, shift));
  },
  tool: (kind, radius) => {
    for (const id of ["on", "beside", "paint", "erase"]) document.getElementById(id).checked = id === kind;
    document.getElementById("brush").value = radius;
  },
  stroke: (from, ...more) => {
    elements.canvas.onpointerdown(at(...from));
    for (const to of more) elements.canvas.onpointermove(at(...to));
    elements.canvas.onpointerup(at(...(more.at(-1) ?? from)));
  },
  row: (k) => elements.objects.children[k].onclick(),
  zoom: (x, y) => elements.canvas.onwheel({ ...at(x, y), deltaY: -1 }),
  rename: (k, name) => { renamed = name; own(k, 2); },
  clear: (k) => own(k, 3),
  remove: (k) => own(k, 4),
  undo: () => elements.undo.onclick(),
  save: () => elements.save.onclick(),
  add: (name) => { document.getElementById("name").value = name; elements.add.onsubmit({ preventDefault() {} }); },
  wait: () => new Promise((done) => setTimeout(done, 200)), // until a live page has asked for the newest image
};
(async () => {
  (0, eval)(script.replace('"use strict";', ""));
  await new Promise((done) => setTimeout(done, 20));
  for (const [name, ...how] of given.steps) {
    await steps[name](...how);
    await new Promise((done) => setTimeout(done, 5));
  }
  if (!given.session.live) await elements.finish.onclick();
  const rows = elements.objects.children.map((row) => row.children[1].textContent);
  const seen = JSON.stringify({ sent, rows, message: elements.message.textContent,
    doubts: elements.doubts.textContent, asked, tinted: drawn.filter(([what]) => what === "rect").map(([, ...box]) => box) });
  process.stdout.write(`${seen}\n`, () => process.exit(0)); // a live page never ends by itself
})();
