// Copyright 2026 The t3mpc_ros developers
// SPDX-License-Identifier: Apache-2.0
// The live page: asks for what is new, draws it, and sends commands.
'use strict';

const KEPT = 125; // s of samples of a live run
const FRAME = 100; // ms between two pictures
const POLL = 100; // ms between two requests, 2 s in a hidden tab
const PATIENCE = 2000; // ms without an answer after which the program counts as lost
const CONFIRM = 500; // ms within which a stop must be confirmed, and between two attempts
const RELOAD = 30000; // ms for which a stop is asked for again after the page loads itself anew

const place = (id) => document.getElementById(id);
const token = document.querySelector('meta[name="token"]').content;
const readOnly = token === '';

const streams = {}; // name -> {time: [], values: [[], …]}
const facts = {};
const events = [];
let lastId = '';
let clock = null; // s to add to the time of the page for the clock of the program
let connected = false;
let stopping = ''; // why a stop is not confirmed yet
let changed = true;
let selection = null; // [from, to] while the charts do not follow the run
let base = null; // pose of the odometry frame on the map
let cursorTime = null;

// -- news ----------------------------------------------------------------------------------------

const seconds = () => performance.now() / 1000;
const pause = (time) => new Promise((resume) => { wake = resume; setTimeout(resume, time); });
let wake = () => {};
document.addEventListener('visibilitychange', () => wake());

// Each request is answered at once: a connection that waited would be missing to the e-stop, as a
// browser has six of them for all tabs.
async function poll() {
  for (;;) {
    try {
      const patience = AbortSignal.timeout(lastId ? PATIENCE : 30 * PATIENCE);
      const reply = await fetch(`events?last=${encodeURIComponent(lastId)}`, { signal: patience });
      const { id, now, ...news } = await reply.json();
      const start = (text) => text.slice(0, text.lastIndexOf('-'));
      if (lastId && start(id) !== start(lastId)) location.reload(); // another start of the program
      lastId = id;
      clock = Math.max(now - seconds(), (clock ?? -Infinity) - 1e-4); // the fastest answer
      setConnected(true);
      take(news);
    } catch {
      setConnected(false);
    }
    await pause(document.hidden ? 2000 : POLL);
  }
}

function take(news) {
  for (const [name, { time, values }] of Object.entries(news.streams || {})) add(name, time, values);
  for (const [name, value] of Object.entries(news.facts || {})) {
    facts[name] = value;
    if (name === 'banner') showBanner();
    if (name === 'nodes') showButtons();
    if (name === 'recording') showRecording();
    if (name.startsWith('parameters/')) showParameters(name.slice('parameters/'.length));
    if (name === 'terms') makeCharts();
  }
  for (const event of news.events || []) addEvent(event);
  changed = true;
}

function add(name, time, values) {
  let kept = streams[name];
  if (!kept || kept.time.at(-1) > time[0] || kept.values.length !== values.length) {
    kept = streams[name] = { time: [], values: values.map(() => []) };
    if (name === 'odometry') base = null;
  }
  kept.time.push(...time);
  kept.values.forEach((column, i) => column.push(...values[i]));
  let old = 0;
  while (!facts.recording && kept.time[old] < kept.time.at(-1) - KEPT) old++;
  if (old > 200) [kept.time, ...kept.values].forEach((column) => column.splice(0, old));
}

function setConnected(now) {
  if (connected === now) return;
  connected = now;
  showBanner();
}

// -- banner --------------------------------------------------------------------------------------

function showBanner() {
  let shown = connected ? facts.banner || { kind: 'lost', headline: 'Connected', detail: '' }
    : { kind: 'lost', headline: 'This page has lost its program',
      detail: 'It connects again by itself as soon as t3mpc view runs.' };
  if (stopping) {
    shown = { kind: 'unconfirmed', headline: 'STOP NOT CONFIRMED: use the switch on the robot',
      detail: `${stopping}; asking again` };
  }
  place('banner').className = shown.kind;
  place('headline').textContent = shown.headline;
  place('detail').textContent = shown.detail;
  document.title = `${shown.headline} – t3mpc_ros`;
  place('release').hidden = readOnly || shown.headline !== 'E-STOP';
  place('e-stop').disabled = readOnly;
}

// -- commands ------------------------------------------------------------------------------------

// Send a command; return what was done, or throw why not.
async function send(name, args, asked, patience) {
  const reply = await fetch('command', {
    method: 'POST',
    headers: { 'Content-Type': 'application/json', 'X-Token': token },
    body: JSON.stringify({ command: name, arguments: args, asked: asked ?? undefined }),
    signal: AbortSignal.timeout(patience),
    priority: 'high',
  });
  const result = await reply.json();
  if (!reply.ok) throw new Error(result.error);
  return result.done;
}

const asked = () => clock === null ? null : clock + seconds();

async function command(name, args = {}) {
  const answer = place('answer');
  answer.className = '';
  answer.textContent = `${name} …`;
  try {
    answer.textContent = await send(name, args, asked(), 5000);
    return true;
  } catch (error) {
    answer.className = 'failed';
    answer.textContent = `not done: ${error.message}`;
    return false;
  }
}

// Ask for a stop until it is confirmed. What asks may overlap: a stop may arrive twice.
let attempts = null;

async function emergencyStop() {
  if (readOnly || attempts) return;
  const time = asked();
  attempts = setTimeout(() => unconfirmed('no answer yet'), CONFIRM);
  sessionStorage.setItem('stop', Date.now());
  for (;;) {
    const next = new Promise((resume) => { setTimeout(resume, CONFIRM); });
    try {
      const done = await send('e_stop', { on: true }, time, 2 * CONFIRM);
      place('answer').className = '';
      place('answer').textContent = done;
      break;
    } catch (error) {
      unconfirmed(error.name === 'TimeoutError' ? 'no answer' : error.message);
    }
    await next;
  }
  clearTimeout(attempts);
  attempts = null;
  sessionStorage.removeItem('stop');
  unconfirmed('');
}

function unconfirmed(why) {
  stopping = why;
  showBanner();
}

const BUTTONS = [
  ['controller', 'Enable', 'enable', { on: true }, 'Let the controller drive'],
  ['controller', 'Disable', 'enable', { on: false }, 'Stop the robot; Enable drives on'],
  ['controller', 'Reset controller', 'reset', {}, 'Discard what was learnt in this run'],
  ['robot', 'Reset odometry', 'reset_odometry', {}, 'Set the odometry to the origin'],
  ['reference_generator', 'Pause reference', 'pause', { on: true }, 'The reference rests'],
  ['reference_generator', 'Resume reference', 'pause', { on: false }, 'The reference goes on'],
  ['reference_generator', 'Reseed', 'reseed', {}, 'Another path, from a random seed'],
];

function showButtons() {
  const nodes = new Set(facts.nodes);
  if (nodes.has('sim_robot') || nodes.has('radio_bridge')) nodes.add('robot');
  place('buttons').replaceChildren(...BUTTONS.filter(([node]) => nodes.has(node)).map(
    ([, text, name, args, title]) => element('button', { type: 'button', textContent: text, title,
      disabled: readOnly, onclick: () => command(name, args) })));
  if (readOnly) place('answer').textContent = 'started with --read-only: commands are off';
}

place('e-stop').onclick = emergencyStop;
place('release').onclick = () => command('e_stop', { on: false });

// The space bar stops wherever the focus is, but where a text is typed: before the focused element
// gets it (a button would be pressed, a list opened), when it goes down and when it comes up.
const isText = (target) => target.matches?.('input[type="text"], input[type="search"], textarea');
const isStop = (key) => key.code === 'Space' && !readOnly && !facts.recording && !isText(key.target)
  && !(key.ctrlKey || key.metaKey || key.altKey);
for (const kind of ['keydown', 'keyup']) {
  window.addEventListener(kind, (key) => {
    if (!isStop(key)) return;
    key.preventDefault();
    key.stopPropagation();
    if (kind === 'keydown' && !key.repeat) emergencyStop();
  }, { capture: true });
}
document.addEventListener('keydown', (key) => {
  if (key.target.closest('input, select, button, textarea, summary') || key.ctrlKey || key.metaKey) return;
  if (key.key === 'h') hold(selection ? null : visibleRange());
});

// A recording has no commands; all of it is shown, and the cursor moves the robot.
function showRecording() {
  for (const id of ['stop-box', 'drawer']) place(id).hidden = true;
  document.querySelector('main').classList.add('recording');
  if (!place('span').querySelector('[value="Infinity"]')) {
    place('span').prepend(element('option', { value: 'Infinity', textContent: 'all' }));
    place('span').value = 'Infinity';
  }
}

// -- parameters ----------------------------------------------------------------------------------

function showParameters(node) {
  const id = `node-${node}`;
  const rows = (facts[`parameters/${node}`] || []).filter((row) => row.dynamic);
  let box = place(id);
  if (!rows.length) { box?.remove(); return; }
  if (!box) {
    box = element('div', { id });
    const after = [...place('parameters').children].find((each) => each.id > id);
    place('parameters').insertBefore(box, after || null);
  }
  for (const [title, part] of groups(node, rows)) {
    const key = `${id}-${title}`;
    const group = place(key) || box.appendChild(
      element('details', { id: key }, element('summary', { textContent: title })));
    for (const row of part) showParameter(node, row, group);
  }
  filterParameters();
}

function groups(node, rows) {
  const faults = rows.filter((row) => row.name.startsWith('faults.'));
  const others = rows.filter((row) => !row.name.startsWith('faults.'));
  return [[`Faults of ${node}`, faults], [node, others]].filter(([, part]) => part.length);
}

function showParameter(node, row, group) {
  const id = `${node}/${row.name}`;
  const known = place(id);
  if (known) { known.show(row.value); return; }
  const { input, read, write } = entry(row);
  const send = () => {
    const value = read();
    if (value !== undefined && JSON.stringify(value) !== JSON.stringify(box.value)) {
      command('set', { node, name: row.name, value })
        .then((done) => { if (done) box.value = value; else write(box.value); });
    }
  };
  const unit = row.unit ? ` ${row.unit}` : '';
  const bounds = row.low === null && row.high === null ? ''
    : ` (${row.low === null ? '' : `from ${row.low} `}${row.high === null ? '' : `to ${row.high}`}${unit})`;
  const box = element('div', { id, className: 'parameter' },
    element('label', {}, element('span', { textContent: row.name }),
      element('span', { className: 'entry' }, input, unit)));
  const slider = makeSlider(row, read, write, send);
  if (slider) box.append(slider);
  box.append(element('p', { textContent: `${row.text}${bounds}` }));
  input.onchange = send;
  input.disabled = readOnly;
  box.show = (value) => {
    box.value = value;
    if (document.activeElement !== input) { write(value); slider?.place(value); }
  };
  box.show(row.value);
  group.append(box);
}

// The input of a parameter, and how to read and write its value.
function entry(row) {
  if (row.type === 'bool') {
    const input = element('input', { type: 'checkbox' });
    return { input, read: () => input.checked, write: (value) => { input.checked = value; } };
  }
  if (row.choices.length) {
    const input = element('select', {}, ...row.choices.map((each) => element('option', { textContent: each })));
    return { input, read: () => input.value, write: (value) => { input.value = value; } };
  }
  const isNumber = row.type === 'float' || row.type === 'int';
  const isList = row.type.startsWith('list');
  const input = element('input', isNumber ? { type: 'number', step: 'any' } : { type: 'text' });
  const read = () => {
    if (!isNumber && !isList) return input.value;
    try { return isList ? JSON.parse(`[${input.value}]`) : JSON.parse(input.value); } catch { return undefined; }
  };
  return { input, read, write: (value) => { input.value = isList ? value.join(', ') : value; } };
}

// A slider for a number with bounds. Its middle is the first value, for ranges of many decades.
function makeSlider(row, read, write, send) {
  if (!['float', 'int'].includes(row.type) || row.low === null || row.high === null) return null;
  const span = row.high - row.low;
  const share = (row.value - row.low) / span;
  const power = row.low < 0 || share <= 0 ? 1 : Math.min(12, Math.max(1, Math.log(share) / Math.log(0.5)));
  const slider = element('input', { type: 'range', min: 0, max: 1000, disabled: readOnly,
    ariaLabel: `${row.name}, slider` });
  slider.place = (value) => { slider.value = 1000 * ((value - row.low) / span) ** (1 / power); };
  slider.oninput = () => {
    const value = row.low + span * (slider.value / 1000) ** power;
    write(row.type === 'int' ? Math.round(value) : +value.toPrecision(3));
  };
  slider.onchange = send;
  return slider;
}

function filterParameters() {
  const words = place('search').value.toLowerCase().split(/\s+/).filter(Boolean);
  for (const box of place('parameters').querySelectorAll('.parameter')) {
    const text = box.textContent.toLowerCase();
    box.hidden = !words.every((word) => text.includes(word));
  }
  for (const group of place('parameters').querySelectorAll('details')) {
    const found = group.querySelectorAll('.parameter:not([hidden])').length;
    group.hidden = !found;
    if (words.length) group.open = found > 0;
  }
}
place('search').oninput = filterParameters;

// -- events --------------------------------------------------------------------------------------

const EVENT_COLOURS = { switch: 'reference', fault: 'c4', stop: 'stopped', command: 'accent', note: 'line' };

function addEvent(event) {
  events.push(event);
  if (events.length > 500) events.shift();
  if (charts) charts.marks = events.filter((each) => each.kind !== 'note')
    .map(({ time, kind }) => ({ time, colour: EVENT_COLOURS[kind] }));
  const row = element('li', { className: event.kind },
    element('span', { className: 'numbers', textContent: `${number(event.time, 1)} s` }),
    element('span', { textContent: event.kind }), element('span', { textContent: event.text }));
  place('events').prepend(row);
  while (place('events').children.length > 200) place('events').lastChild.remove();
}

// -- pictures ------------------------------------------------------------------------------------

const floor = new Floor(place('floor'));
let charts = null;
const made = {};

function makeCharts() {
  if (charts) return;
  charts = new ChartGroup(place('charts'), {
    moved: (time) => {
      cursorTime = time;
      place('cursor-time').textContent = time === null ? '' : `cursor at ${number(time, 2)} s`;
      changed = true;
    },
    selected: (from, to) => hold(from === null ? null : [from, to]),
  });
  const wheel = (name, label) => [
    { label: 'reference', colour: 'reference', dash: [6, 4] }, { label: 'measured', colour: name },
    { label: 'command', colour: 'c3', dash: [2, 3] }];
  made.right = charts.add('Right wheel', 'rad/s', wheel('right'));
  made.left = charts.add('Left wheel', 'rad/s', wheel('left'));
  made.error = charts.add('Error', 'rad/s', [{ label: 'right', colour: 'right' },
    { label: 'left', colour: 'left', dash: [6, 3] }]);
  const dashes = [[], [6, 3], [2, 3], [8, 3, 2, 3], [1, 4]];
  made.terms = charts.add('Terms of the control law, right wheel', 'rad/s²',
    facts.terms.map((label, i) => ({ label, colour: `c${i + 1}`, dash: dashes[i] })));
}

const empty = (columns) => [[], ...Array.from({ length: columns }, () => [])];
const table = (name, ...columns) => {
  const kept = streams[name];
  return kept ? [kept.time, ...columns.map((i) => kept.values[i])] : empty(columns.length);
};

function visibleRange() {
  const newest = streams.odometry?.time.at(-1);
  const span = Number(place('span').value);
  if (newest === undefined) return null;
  return [span < Infinity ? newest - span : streams.odometry.time[0], newest + 0.5];
}

function hold(range) {
  selection = range;
  place('hold').setAttribute('aria-pressed', String(Boolean(range)));
  place('hold').textContent = range ? 'Follow' : 'Hold';
  changed = true;
}
place('hold').onclick = () => hold(selection ? null : visibleRange());
place('span').onchange = () => { selection = null; hold(null); };

function drawCharts() {
  if (!charts) return;
  for (const [i, name] of ['right', 'left'].entries()) {
    charts.set(made[name], [table('reference', i), table('odometry', i), table('command', i)]);
  }
  const [time, ...measured] = table('odometry', 0, 1);
  const [at, ...wanted] = table('reference', 0, 1);
  charts.set(made.error, [[time, ...measured.map((column, i) => {
    const expected = interpolate(at, wanted[i], time);
    return column.map((value, k) => (expected[k] === null || value === null ? null : value - expected[k]));
  })]]);
  charts.set(made.terms, [table('terms', ...facts.terms.map((_, i) => 2 * i))]);
  charts.draw(selection || visibleRange());
}

function last(name, first, count) {
  const kept = streams[name];
  if (!kept?.time.length) return null;
  let row = kept.time.length - 1;
  if (cursorTime !== null) while (row > 0 && kept.time[row] > cursorTime) row--;
  const values = kept.values.slice(first, first + count).map((column) => column[row]);
  return values.includes(null) && count === 3 ? null : values;
}

function path(name, look, frame) {
  const kept = streams[name];
  if (!kept) return null;
  const [from, to] = selection || [-Infinity, Infinity];
  const result = { x: [], y: [], ...look };
  for (let i = 0; i < kept.time.length; i += 2) {
    if (kept.time[i] < from || kept.time[i] > to) continue;
    const pose = [kept.values[2][i], kept.values[3][i], 0];
    if (pose.includes(null)) continue;
    const [x, y] = frame ? compose(frame, pose) : pose;
    result.x.push(x);
    result.y.push(y);
  }
  return result;
}

const PATHS = [
  ['reference', 'reference', { colour: 'reference', dash: [6, 4] }],
  ['odometry', 'odometry', { colour: 'right' }],
  ['truth', 'true path (simulation only)', { colour: 'truth', dash: [2, 3] }],
];

// The frame of the odometry is laid on the true pose once, at the begin of what is kept: later,
// their distance is the drift. A real robot has no true pose.
function layBase() {
  const [odometry, truth] = [streams.odometry, streams.truth];
  if (!odometry || (base && (base.known || !truth))) return;
  const row = truth ? odometry.time.findIndex((each) => each >= truth.time[0]) : 0;
  if (row < 0) return;
  const pose = ({ values }, i) => values.slice(2, 5).map((column) => column[i]);
  const frame = truth ? compose(pose(truth, 0), inverse(pose(odometry, row))) : [0, 0, 0];
  base = Object.assign(frame, { known: Boolean(truth) });
}

function drawFloor() {
  const truth = last('truth', 2, 3);
  const odometry = last('odometry', 2, 3);
  layBase();
  const paths = PATHS.map(([name, , look]) => path(name, look, name === 'truth' ? null : base)).filter(Boolean);
  const robot = truth || (odometry && base && compose(base, odometry));
  floor.draw({ world: facts.world, paths, robot, mounts: facts.mounts,
    ranges: last('ranges', 0, 8), track: facts.robot?.wheel_separation });
  if (robot) {
    const speeds = last('odometry', 0, 2);
    const degrees = (((robot[2] * 180) / Math.PI + 180) % 360 + 360) % 360 - 180;
    place('pose').textContent = `x ${number(robot[0], 2)} m, y ${number(robot[1], 2)} m, `
      + `yaw ${number(degrees, 0)}°, wheels ${number(speeds[0], 1)} and ${number(speeds[1], 1)} rad/s`;
  }
}

place('floor-legend').append(...PATHS.map(([, label, { colour: name, dash }]) =>
  element('li', {}, sample(name, dash), label)), element('li', {}, sample('ray'), 'range'));

setInterval(() => {
  if (!changed || document.hidden) return;
  changed = false;
  drawCharts();
  drawFloor();
}, FRAME);
theme.addEventListener('change', () => { changed = true; });

showBanner();
poll();
if (Date.now() - sessionStorage.getItem('stop') < RELOAD) emergencyStop(); // not confirmed before
