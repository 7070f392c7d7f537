// Copyright 2026 The t3mpc_ros developers
// SPDX-License-Identifier: Apache-2.0
// The live page: asks for what is new, and keeps it.
'use strict';

const POLL = 100; // ms between two requests, 2 s in a hidden tab
const PATIENCE = 2000; // ms without an answer after which the program counts as lost
const GAP = 0.5; // s without a sample after which a line is interrupted

const place = (id) => document.getElementById(id);
const token = document.querySelector('meta[name="token"]').content;
const readOnly = token === '';

const streams = {}; // name -> {time: [], values: [[], …]}
const facts = {};
const events = [];
let lastId = '';
let clock = null; // s to add to the time of the page for the clock of the program
let replied = -Infinity; // s, when the newest request was sent that has a reply
let connected = false;
let changed = true; // whether the charts must be drawn
let moved = true; // whether the floor must be drawn
let base = null; // pose of the odometry frame on the map

const steady = () => performance.now() / 1000;
const pause = (time) => new Promise((resume) => { wake = resume; setTimeout(resume, time); });
let wake = () => {};
document.addEventListener('visibilitychange', () => wake());

// Each request is answered at once: a connection that waited would be missing to the e-stop, as a
// browser has six of them for all tabs.
async function poll() {
  for (;;) {
    let more = false;
    try {
      const sent = steady();
      const patience = AbortSignal.timeout(lastId ? PATIENCE : 30 * PATIENCE);
      // With a cache, equal requests of several tabs would wait for each other.
      const reply = await fetch(`events?last=${encodeURIComponent(lastId)}`, { signal: patience, cache: 'no-store' });
      const { id, now, ...news } = await reply.json();
      const start = (text) => text.replace(/-\d+-\d+$/, '');
      if (lastId && start(id) !== start(lastId)) location.reload(); // another start of the program
      lastId = id;
      clock = Math.max(now - steady(), (clock ?? -Infinity) - 1e-4); // the fastest answer
      replied = sent;
      setConnected(true);
      take(news);
      if (stopping) showBanner();
      more = news.more;
    } catch {
      setConnected(false);
    }
    if (!more) await pause(document.hidden ? 2000 : POLL);
  }
}

function take(news) {
  for (const [name, value] of Object.entries(news.facts || {})) {
    facts[name] = value;
    if (name === 'banner' || name === 'namespace') showBanner();
    if (name === 'nodes') showButtons();
    if (name === 'recording') showRecording();
    if (name === 'recorder') showRecorder();
    if (name.startsWith('parameters/')) showParameters(name.slice('parameters/'.length));
    if (name === 'parameters/reference_generator') showDrawing();
  }
  if (news.facts?.terms) makeCharts();
  for (const [name, { time, values }] of Object.entries(news.streams || {})) add(name, time, values);
  for (const event of news.events || []) addEvent(event);
  changed = moved = true;
}

function add(name, time, values) {
  let kept = streams[name];
  if (!kept || kept.time.at(-1) > time[0] || kept.values.length !== values.length) {
    kept = streams[name] = { time: [], values: values.map(() => []) };
    if (name === 'odometry') base = null;
  }
  time.forEach((at, row) => {
    const before = kept.time.at(-1);
    if (at > before + GAP) append(kept, before + 1e-6, values.map(() => null));
    append(kept, at, values.map((column) => column[row]));
  });
  const old = rowAt(kept.time, kept.time.at(-1) - (facts.span ?? Infinity)) + 1;
  if (old > 1000) [kept.time, ...kept.values].forEach((column) => column.splice(0, old));
}

function append(kept, time, row) {
  kept.time.push(time);
  kept.values.forEach((column, i) => column.push(row[i]));
}

function setConnected(now) {
  if (connected === now) return;
  connected = now;
  showBanner();
}

// Time of the run, and its end, as far as they are kept.
const begin = () => streams.odometry && Math.max(streams.odometry.time[0], newest() - (facts.span ?? Infinity));
const newest = () => streams.odometry?.time.at(-1);

// A time of the run in words: of the clock, or in a recording since its begin, as in its report.
function timeText(time, digits = 0) {
  if (!facts.origin || (facts.recording && !facts.recording.live)) return seconds(time, 2);
  return clockText(time, digits);
}

function clockText(time, digits = 0) {
  const tick = 10 ** digits;
  const at = new Date(Math.round((facts.origin + time) * tick) / tick * 1000);
  const two = (value) => String(value).padStart(2, '0');
  const rest = digits ? (at.getMilliseconds() / 1000).toFixed(digits).slice(1) : '';
  return `${two(at.getHours())}:${two(at.getMinutes())}:${two(at.getSeconds())}${rest}`;
}

function start() {
  showBanner();
  const shared = place('shared');
  if (shared) { // a file that someone has sent: all that there is
    connected = true;
    take(JSON.parse(shared.textContent));
    return;
  }
  poll();
  if (Date.now() - keptStop() < RELOAD) emergencyStop(); // not confirmed before
}

document.addEventListener('DOMContentLoaded', start); // after the other scripts
