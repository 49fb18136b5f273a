// Rerun's web viewer, in a frame of ours: a recording shown, its time moved.
"use strict";

const TIMELINE = "flight_time";
const canvas = document.getElementById("canvas");
const state = document.getElementById("state");
let handle = null;
let channel = 0;

/** A protobuf field of wire type 2: bytes. */
function field(number, bytes) {
  return [(number << 3) | 2, ...varint(bytes.length), ...bytes];
}

function varint(value) {
  const out = [];
  for (let rest = BigInt.asUintN(64, BigInt(value)); ; rest >>= 7n) {
    if (rest < 128n) return [...out, Number(rest)];
    out.push(Number(rest & 127n) | 128);
  }
}

/**
 * The request of Rerun's viewer control that moves the time cursor to seconds of the flight's own clock, and pauses
 * there. Its format is that of the release that pyproject.toml pins; a test moves it.
 */
function setTime(seconds) {
  const timeline = field(1, [...new TextEncoder().encode(TIMELINE)]);
  const time = [8, ...varint(Math.round(seconds * 1e9))];
  const paused = [40, 1];
  return new Uint8Array(field(6, [...field(2, timeline), ...field(3, time), ...paused]));
}

/** The fields of a protobuf message by their numbers: bytes, or a whole number. */
function fields(bytes) {
  const found = {};
  for (let at = 0; at < bytes.length; ) {
    const number = () => {
      let value = 0n;
      for (let shift = 0n; ; shift += 7n) {
        const byte = bytes[at++];
        value |= BigInt(byte & 127) << shift;
        if (byte < 128) return value;
      }
    };
    const key = Number(number());
    if ((key & 7) === 0) found[key >> 3] = number();
    else if ((key & 7) === 2) {
      const length = Number(number());
      found[key >> 3] = bytes.subarray(at, at + length);
      at += length;
    } else break;
  }
  return found;
}

let wanted = null;

/** Move the viewer's time there, as soon as it has the recording, and tell the page where it says that it is. */
async function moveTo(seconds) {
  wanted = seconds;
  while (wanted === seconds) {
    try {
      await move(seconds);
      wanted = null;
    } catch {
      await new Promise((again) => setTimeout(again, 300));
    }
  }
}

async function move(seconds) {
  if (handle === null || !channel) throw new Error("not yet");
  const answer = fields(fields(await handle.viewer_control(setTime(seconds)))[6]);
  window.parent.postMessage({ at: Number(fields(answer[4])[1] ?? 0n) / 1e9 }, location.origin);
}

window.showRecording = async (url) => {
  const answer = await fetch(url);
  if (!answer.ok) return void (state.textContent = "this recording is no longer there");
  const bytes = new Uint8Array(await answer.arrayBuffer());
  if (channel) handle.close_channel(`recording-${channel}`);
  channel += 1;
  handle.open_channel(`recording-${channel}`, "trueflight");
  handle.send_rrd_to_channel(`recording-${channel}`, bytes);
};

async function begin() {
  if (typeof wasm_bindgen === "undefined") throw new Error("the viewer's files are not there");
  await wasm_bindgen("/viewer/re_viewer_bg.wasm");
  handle = new wasm_bindgen.WebHandle({
    url: [], manifest_url: null, render_backend: null, video_decoder: null, hide_welcome_screen: true,
    enable_history: false, notebook: false, persist: false, theme: "dark", // the recordings are drawn for it,
  });
  await handle.start(canvas);
  state.hidden = true;
  window.parent.postMessage("ready", location.origin);
  await window.showRecording(document.body.dataset.recording);
}

window.addEventListener("message", (event) => {
  if (event.origin === location.origin && typeof event.data?.seconds === "number") void moveTo(event.data.seconds);
});

begin().catch((error) => {
  state.hidden = false;
  state.textContent = `the viewer does not start here: ${error}`;
});
