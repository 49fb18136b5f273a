// The page's own script: what changed is fetched panel by panel; everything that is asked goes by JSON.
"use strict";

const panels = () => [...document.querySelectorAll("[data-panel]")];
const byId = (id) => document.getElementById(id);

/** Ask the server for something; its one line of why not goes to `where`. */
async function ask(path, asked, where) {
  const answer = await fetch(path, {
    method: "POST",
    headers: { "Content-Type": "application/json" },
    body: JSON.stringify(asked),
  }).catch(() => null);
  if (answer === null) return void lost(true);
  const told = await answer.json().catch(() => ({ problem: `refused (${answer.status})` }));
  say(where ?? byId("said"), told.problem ?? "");
}

function say(place, text) {
  if (!place) return;
  place.textContent = text;
  place.hidden = text === "";
}

function lost(is) {
  byId("lost").hidden = !is;
}

// --- what changed -------------------------------------------------------------------------------------------------

const newest = {};
const HEAD = 160; // px that stand at the top of the window

/** Put the newest state of a panel in place, with the focus, what is unfolded and what was typed kept. */
async function refresh(panel) {
  const name = panel.dataset.panel;
  const answer = await fetch(`/panels/${name}`).catch(() => null);
  if (!answer?.ok) return;
  const body = await answer.text();
  const focus = panel.contains(document.activeElement) ? describe(document.activeElement) : null;
  const open = new Map([...panel.querySelectorAll("details[data-keep]")].map((d) => [d.dataset.keep, d.open]));
  const before = panel.getBoundingClientRect();
  panel.innerHTML = body;
  // what is above what is being read changes its height, and moves nothing
  if (before.bottom < HEAD) window.scrollBy({ top: panel.getBoundingClientRect().height - before.height, behavior: "instant" });
  panel.dataset.revision = answer.headers.get("X-Revision");
  for (const details of panel.querySelectorAll("details[data-keep]"))
    if (open.has(details.dataset.keep) && !details.querySelector(".wrong")) details.open = open.get(details.dataset.keep);
  if (focus) panel.querySelector(focus)?.focus({ preventScroll: true });
  const wrong = panel.querySelector("[aria-invalid]");
  if (wrong) wrong.focus();
  showRecording();
  showProgress();
}

function describe(element) {
  if (element.id) return `#${CSS.escape(element.id)}`;
  const marks = ["data-ask", "data-effects", "data-version", "data-flight", "data-seconds", "name", "value"];
  const given = marks.filter((m) => element.hasAttribute(m)).map((m) => `[${m}="${CSS.escape(element.getAttribute(m))}"]`);
  return given.length ? element.tagName.toLowerCase() + given.join("") : null;
}

let refreshing = Promise.resolve();
function heard(told) {
  lost(false);
  Object.assign(newest, told);
  showProgress();
  refreshing = refreshing.then(async () => {
    for (const panel of panels())
      if (String(newest.panels[panel.dataset.panel]) !== panel.dataset.revision) await refresh(panel);
  });
}

function listen() {
  const events = new EventSource("/events");
  events.onmessage = (event) => heard(JSON.parse(event.data));
  events.onerror = () => setTimeout(() => lost(events.readyState !== EventSource.OPEN), 3000);
  events.onopen = () => lost(false);
}

let since = 0;
function showProgress() {
  const now = newest.progress;
  const bar = byId("bar");
  if (!now || !bar) return;
  since = performance.now() - 1000 * now.seconds;
  if (now.step > 0) bar.value = now.step - 0.5;
  say(byId("doing-text"), `${now.step} of ${now.steps}: ${now.text}`);
}
setInterval(() => {
  const time = byId("doing-time");
  if (time && newest.progress) time.textContent = `${((performance.now() - since) / 1000).toFixed(0)} s`;
}, 500);

// --- what is asked ------------------------------------------------------------------------------------------------

document.addEventListener("click", (event) => {
  const button = event.target.closest("button");
  if (!button) return;
  const d = button.dataset;
  if (d.ask) {
    const asked = {};
    if (d.effects) asked.effects = d.effects.split(" ");
    if (d.version) asked.version = d.version;
    if (d.flight) asked.flight = Number(d.flight);
    void ask(d.ask, asked, problemNear(button));
  }
  if (d.seconds) jump(Number(d.seconds));
  if (d.copy) void navigator.clipboard?.writeText(d.copy).then(() => (button.textContent = "copied"));
  if ("noHeld" in d) choose(0);
});

/** The line below a button that says why it could not be. */
function problemNear(button) {
  const box = button.closest("article, .panel, .panel-job");
  let line = box.querySelector(":scope > .asked-problem");
  if (!line) {
    line = document.createElement("p");
    line.className = "problem asked-problem";
    line.setAttribute("role", "alert");
    box.append(line);
  }
  return line;
}

function choose(held) {
  const fitted = document.querySelector("input[name=fitted]:checked")?.value ?? 0;
  void ask("/choose", { fitted, held_out: held }, byId("drop-problem"));
}

document.addEventListener("change", (event) => {
  const input = event.target;
  if (input.id === "files" || input.id === "folder")
    void send([...input.files].map((f) => [f, f.webkitRelativePath || f.name]));
  if ("choose" in input.dataset) {
    const held = document.querySelector("input[name=held]:checked")?.value ?? 0;
    const fitted = document.querySelector("input[name=fitted]:checked")?.value;
    choose(held === fitted ? 0 : held);
  }
});

document.addEventListener("submit", (event) => {
  event.preventDefault();
  const form = event.target;
  const data = new FormData(form);
  if (form.dataset.vehicle)
    void ask("/vehicle", { flight: Number(form.dataset.vehicle), values: Object.fromEntries(data) }, problemNear(form));
  if ("beside" in form.dataset)
    void ask("/beside", { flights: data.getAll("flight"), models: data.getAll("model") }, problemNear(form));
});

document.addEventListener("keydown", (event) => {
  if (event.key === "Enter" && event.target.matches("label.button")) event.target.querySelector("input").click();
  if (event.key === "Escape" && document.querySelector('[data-ask="/cancel"]')) void ask("/cancel", {});
});

// --- what is dropped ----------------------------------------------------------------------------------------------

async function filesOf(entry, path) {
  if (entry.isFile) return [[await new Promise((done, fail) => entry.file(done, fail)), path + entry.name]];
  const reader = entry.createReader();
  const found = [];
  for (;;) {
    const some = await new Promise((done, fail) => reader.readEntries(done, fail));
    if (!some.length) break;
    for (const one of some) found.push(...(await filesOf(one, `${path}${entry.name}/`)));
  }
  return found;
}

document.addEventListener("dragover", (event) => {
  event.preventDefault();
  byId("drop-here").hidden = false;
});
document.addEventListener("dragleave", (event) => {
  if (!event.relatedTarget) byId("drop-here").hidden = true;
});
document.addEventListener("drop", async (event) => {
  event.preventDefault();
  byId("drop-here").hidden = true;
  const items = [...event.dataTransfer.items].map((i) => i.webkitGetAsEntry?.()).filter(Boolean);
  const plain = [...event.dataTransfer.files].map((f) => [f, f.name]);
  const found = items.length ? (await Promise.all(items.map((i) => filesOf(i, "")))).flat() : plain;
  await send(found);
});

/** Send the files of one drop, one after the other; then say that they belong together. */
async function send(files) {
  const batch = crypto.randomUUID?.() ?? String(Math.random());
  const problem = byId("drop-problem");
  const several = files.length > 1;
  const refused = [];
  say(problem, "");
  let sent = 0;
  for (const [file, name] of files) {
    if (name.split("/").some((part) => part.startsWith("."))) continue;
    say(byId("uploading"), `taking ${name} (${(file.size / 1e6).toFixed(1)} MB)`);
    const answer = await fetch("/upload", {
      method: "POST",
      headers: { "Content-Type": "application/octet-stream", "X-Name": encodeURIComponent(name), "X-Batch": batch },
      body: file,
    }).catch(() => null);
    if (answer?.ok) sent += 1;
    else if (answer) refused.push((await answer.json().catch(() => ({ problem: "refused" }))).problem);
    else refused.push(`${name}: could not be sent`);
  }
  say(byId("uploading"), "");
  await ask("/drop", { batch }, problem);
  // of a folder what is no flight is passed over, as in the terminal
  if (refused.length && (!several || !sent)) say(byId("drop-problem"), refused[0]);
}

// --- the viewer ---------------------------------------------------------------------------------------------------

const frame = () => byId("viewer-frame");
let shown = "";

function wantsViewer() {
  const kept = localStorage.getItem("viewer");
  return kept === null ? window.matchMedia("(min-width: 1100px)").matches : kept === "on";
}

function showViewer(on) {
  localStorage.setItem("viewer", on ? "on" : "off");
  layOut(on);
  showRecording();
}

function layOut(on) {
  byId("viewer").hidden = !on;
  document.body.classList.toggle("with-viewer", on);
  byId("show-viewer").setAttribute("aria-pressed", String(on));
}

/** Show the newest recording: that of the diagnosis, before it that of the comparison. */
function showRecording() {
  const recording = document.querySelector("[data-recording]")?.dataset.recording ?? "";
  if (byId("viewer").hidden || !recording || recording === shown) return;
  shown = recording;
  byId("viewer-shows").textContent = decodeURIComponent(recording.split("/").pop().split("?")[0]);
  if (frame().contentWindow?.showRecording) frame().contentWindow.showRecording(recording);
  else frame().src = `/viewer?recording=${encodeURIComponent(recording)}`;
}

/** Move the viewer's time to a moment of the flight, in s. */
function jump(seconds) {
  if (byId("viewer").hidden) showViewer(true);
  frame().contentWindow?.postMessage({ seconds }, location.origin);
  pending = seconds;
}
let pending = null;
window.addEventListener("message", (event) => {
  if (event.origin !== location.origin || event.source !== frame().contentWindow) return;
  if (event.data === "ready" && pending !== null) frame().contentWindow.postMessage({ seconds: pending }, location.origin);
  if (typeof event.data?.at === "number") byId("viewer").dataset.at = String(event.data.at);
});

byId("show-viewer").addEventListener("click", () => showViewer(byId("viewer").hidden));
layOut(wantsViewer());
showRecording();
listen();
