"use strict";
// Script of the explorer page. The controls are HTML elements, the figures are Bokeh's. One Bokeh data source (`inputs`)
// sends changed values to Python, another one (`answer`) receives the replies.
const start = JSON.parse(document.getElementById("start").textContent);
const by = id => document.getElementById(id);
const STEPS = 1000;
const LABELS = {
  mode: "units", velocity: "velocity estimate", position: "position estimate", feedback: "further feedback", coupling: "compliance",
};
const fields = {};
const CAPTIONS = ["poles_words", "nyquist_words", "bode_words", "step_words", "contact_words"];
let inputs = null, serial = 0, answered = 0, waiting = {}, sent = {}, rests = false, scheduled = false;
// Name of the control that the user is moving, and the one that created the latest entry of the browser's history, so
// that a drag creates only one entry.
let moved = "", entry = "", opens = false, asked = [0, ""];

// Convert between the position of a slider, 0 to STEPS, and its value. The scale is linear for charts and for ranges with
// negative values, logarithmic for ranges above 0, and cubic for ranges from 0.
function valueAt(field, place) {
  const { low, high } = field, share = place / STEPS;
  const value = field.linear || low < 0 ? low + (high - low) * share : low > 0 ? low * (high / low) ** share : high * share ** 3;
  return field.whole ? Math.round(value) : Number(value.toPrecision(4));
}
function placeOf(field, value) {
  const { low, high } = field, held = Math.min(Math.max(value, low), high);
  const share = field.linear || low < 0 ? (held - low) / (high - low) : low > 0 ? Math.log(held / low) / Math.log(high / low) : (held / high) ** (1 / 3);
  return Math.round(share * STEPS);
}
function element(tag, attributes, ...children) {
  const made = Object.assign(document.createElement(tag), attributes);
  made.append(...children);
  return made;
}
function addRow(form, name, label, ...controls) {
  const row = element("div", { className: "row" }, element("label", { htmlFor: name, textContent: label }), ...controls);
  form.append(row);
  return row;
}
// Add the input field of a number; `change` converts the number to changed parameters.
function addNumber(field, name, change = value => ({ [name]: value }), kind = "not a number") {
  const number = field.number = element("input", { type: "number", step: "any", id: name });
  number.addEventListener("input", () => markStale(number.value !== String(field.shown)));
  number.addEventListener("keydown", event => { if (event.key === "Escape") send({}, true); });
  number.addEventListener("change", () => {
    moved = "";
    const wanted = change(number.valueAsNumber);
    if (Object.values(wanted).every(Number.isFinite)) send(wanted, true);
    else refuse([name], `${field.text}: ${kind}; write one, or press Escape`);
  });
  return number;
}
function addSlider(form, name) {
  const field = { slides: true };
  field.range = element("input", { type: "range", min: 0, max: STEPS, step: 1, id: `${name}-slider` });
  field.row = addRow(form, name, "", field.range, addNumber(field, name));
  const slide = rest => {
    field.number.value = valueAt(field, Number(field.range.value));
    field.range.setAttribute("aria-valuetext", `${field.number.value} ${field.unit}`);
    moved = name;
    send({ [name]: Number(field.number.value) }, rest);
  };
  field.range.addEventListener("input", () => slide(false));
  field.range.addEventListener("change", () => slide(true));
  fields[name] = field;
}
// Set labels, units and ranges for linear or for rotary devices.
function setMotion(motion) {
  for (const [name, field] of Object.entries(fields)) {
    if (!field.slides || field.motion === motion) continue;
    Object.assign(field, start.sliders[motion][name], { motion });
    field.text = field.unit ? `${field.label} in ${field.unit}` : field.label;
    field.row.firstElementChild.textContent = field.text;
    field.range.setAttribute("aria-label", `${field.text}, slider`);
  }
}
function addChoice(form, name) {
  const select = element("select", { id: name });
  for (const [value, text] of Object.entries(start.choices[name])) select.append(element("option", { value, textContent: text }));
  select.addEventListener("change", () => { moved = ""; send({ [name]: select.value }, true); });
  fields[name] = { select, row: addRow(form, name, LABELS[name] ?? name, select) };
}
function build() {
  const form = by("controls"), names = Object.keys(start.sliders.linear);
  form.addEventListener("submit", event => event.preventDefault());
  addChoice(form, "mode");
  addChoice(form, "motion");
  for (const name of names.filter(name => !name.includes("."))) {
    addSlider(form, name);
    if (name === "period") {
      const field = fields.rate = { text: "rate 1/T in Hz" };
      const number = addNumber(field, "rate", value => ({ period: value > 0 ? 1e3 / value : NaN }), "not a number above 0");
      field.row = addRow(form, "rate", `or ${field.text}`, element("span"), number);
    }
  }
  for (const part of Object.keys(start.choices).filter(name => name !== "mode" && name !== "motion")) {
    addChoice(form, part);
    for (const name of names.filter(name => name.startsWith(`${part}.`))) addSlider(form, name);
  }
  setMotion("linear");
}

// Send the latest values after the previous reply has arrived. Skip intermediate values, so that no queue builds up.
function send(changes, rest) {
  Object.assign(waiting, changes);
  rests = rests || rest;
  document.body.classList.add("busy");
  flush();
}
function flush() {
  if (inputs === null || scheduled || answered < serial || (Object.keys(waiting).length === 0 && !rests)) return;
  scheduled = true;
  requestAnimationFrame(() => {
    scheduled = false;
    serial += 1;
    const message = { serial, rest: rests, set: waiting, dark: dark.matches, contact: by("contact-wanted").checked };
    if (opens) asked = [serial, location.hash];
    if (opens) message.open = location.hash.slice(1);
    [sent, waiting, opens] = [waiting, {}, false];
    rests = false;
    inputs.data = { json: [JSON.stringify(message)] };
  });
}
// Mark the results as stale while an input field differs from the computed scene.
function markStale(is) {
  document.body.classList.toggle("stale", is);
  by("stale").hidden = !is;
}
function refuse(names, why) {
  by("error").textContent = why;
  markStale(true);
  for (const name of names) fields[name]?.number?.setAttribute("aria-invalid", true);
}
function accept() {
  by("error").textContent = "";
  markStale(false);
  for (const field of Object.values(fields)) field.number?.removeAttribute("aria-invalid");
}
function remember(link, number) {
  const [first, hash] = asked, back = number <= first;
  // Ignore the reply if the user has meanwhile gone to another entry of the history.
  if (opens || (back && location.hash !== hash)) return;
  if (location.hash !== `#${link}`) history[back || (moved && moved === entry) ? "replaceState" : "pushState"](null, "", `#${link}`);
  entry = moved || "-";
}
function show(answer) {
  for (const id of ["word", "radius", ...CAPTIONS]) if (id in answer) by(id).textContent = answer[id];
  for (const id of ["verdict", "slopes"]) if (id in answer) showLines(by(id), answer[id]);
  for (const id of ["yaml", "python"]) if (id in answer) by(id).value = answer[id];
  if ("word" in answer) by("word").dataset.word = answer.word;
  if ("busy" in answer) document.body.classList.toggle("busy", answer.busy);
  if (answer.error && answer.state) refuse(Object.keys(sent), answer.error);
  else if (answer.error) by("error").textContent = answer.error;
  else if ("error" in answer) accept();
  if (answer.state?.motion) setMotion(answer.state.motion);
  if (answer.frame) for (const [k, names] of [[0, ["stiffness", "alpha"]], [1, ["virtual_damping", "beta"]]])
    for (const name of names) Object.assign(fields[name], { low: answer.frame[k][0], high: answer.frame[k][1], linear: true });
  if (answer.state) showState(answer.state);
  if ("link" in answer) remember(answer.link, answer.serial);
  if ("csv" in answer) download(new Blob([answer.csv], { type: "text/csv" }), "csv");
  if ("state" in answer || "error" in answer || "csv" in answer) answered = Math.max(answered, answer.serial);
  flush();
}
// Format of the lines: a label of 10 characters and a space, or a longer label and two spaces, then the text. A line
// indented by 11 spaces continues the text of the previous line.
function showLines(box, text) {
  box.dataset.text = text;
  const lines = text.replace(/\n {11}(?=\S)/g, " ").split("\n");
  box.replaceChildren(...lines.map(line => {
    const [, label, words] = /^(.{10}) (.*)$/.exec(line) ?? /^(\S.*?) {2,}(.*)$/.exec(line) ?? ["", line, ""];
    return element("div", {}, ...[label, words].map(part => element("span", { textContent: part.trim() })));
  }));
}
function showState(state) {
  for (const [name, field] of Object.entries(fields)) {
    field.row.hidden = !((name === "rate" ? "period" : name) in state);
    if (field.row.hidden || name in waiting || field.number?.getAttribute("aria-invalid")) continue;
    if (field.select) field.select.value = state[name];
    else {
      field.shown = Number(field.range ? state[name].toPrecision(10) : (1e3 / state.period).toPrecision(6));
      if (document.activeElement !== field.number || !document.body.classList.contains("stale")) field.number.value = field.shown;
      if (field.range && document.activeElement !== field.range) field.range.value = placeOf(field, state[name]);
      field.range?.setAttribute("aria-valuetext", `${field.number.value} ${field.unit}`);
    }
  }
}
function moveWall(event) {
  const steps = { ArrowLeft: [0, -1], ArrowRight: [0, 1], ArrowUp: [1, 1], ArrowDown: [1, -1] }[event.key];
  if (!steps) return;
  event.preventDefault();
  const names = by("mode").value === "normalized" ? ["alpha", "beta"] : ["stiffness", "virtual_damping"];
  const name = names[steps[0]], field = fields[name];
  const value = field.number.valueAsNumber + steps[1] * (event.shiftKey ? 10 : 1) * (field.high - field.low) / 200;
  field.number.value = Number(value.toPrecision(6));
  moved = "plane";
  send({ [name]: field.number.valueAsNumber }, true);
}
async function copy(text, area) {
  area?.select();
  try {
    await navigator.clipboard.writeText(text);
    by("copied").textContent = "copied";
  } catch {
    by("copied").textContent = area ? "the text is selected: press Ctrl-C" : "not copied: copy it from the address bar";
  }
}
function download(blob, kind) {
  const link = element("a", { href: URL.createObjectURL(blob), download: `zwidth-${by("figure").value}.${kind}` });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60_000);
  by("copied").textContent = `saved ${link.download}`;
}
async function save(kind) {
  const name = by("figure").value;
  by("copied").textContent = by(name).offsetParent === null ? "simulate a hit first" : document.body.matches(".busy") ? "not saved: the computation is still running"
    : document.body.matches(".stale") ? "not saved: an input is invalid; correct it, or press Escape in its field" : "";
  if (by("copied").textContent) return;
  if (kind === "csv") return void (inputs.data = { json: [JSON.stringify({ serial: ++serial, csv: name })] });
  const view = Bokeh.index.get(Bokeh.documents[0].get_model_by_name(name));
  download(await view.export(kind).to_blob(), kind);
}

const dark = window.matchMedia("(prefers-color-scheme: dark)");
dark.addEventListener("change", () => send({}, true));
build();
by("plane").addEventListener("keydown", moveWall);
by("contact-wanted").addEventListener("change", () => send({}, true));
by("plane").addEventListener("pointerdown", () => { moved = ""; });
by("address").addEventListener("click", () => copy(location.href));
for (const button of document.querySelectorAll("[data-copy]")) button.addEventListener("click", () => copy(by(button.dataset.copy).value, by(button.dataset.copy)));
for (const button of document.querySelectorAll("[data-save]")) button.addEventListener("click", () => save(button.dataset.save));
function openAddress() {
  [opens, waiting, moved] = [true, {}, ""];
  send({}, true);
}
window.addEventListener("hashchange", openAddress);
Bokeh.set_log_level("error");
Bokeh.embed.embed_items({}, start.items).then(() => {
  const figures = Bokeh.documents[0];
  inputs = figures.get_model_by_name("inputs");
  const answer = figures.get_model_by_name("answer");
  answer.connect(answer.properties.data.change, () => answer.data.json.forEach(text => show(JSON.parse(text))));
  figures.on_event("connection_lost", () => refuse([], "zwidth explore has ended; start it again"));
  openAddress();
}, error => { by("error").textContent = `the page could not connect: ${error}`; });
