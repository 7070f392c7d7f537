// Copyright 2026 The t3mpc_ros developers
// SPDX-License-Identifier: Apache-2.0
// The charts and the floor: what of the run they show, and at which instant.
'use strict';

const FRAME = 100; // ms between two pictures
const PATH = 120; // s of the path on the floor
const BEFORE = 0.5; // s before a switch that are not settled, as in reports: ROBOT_WINDOW
const AFTER = 1.0; // s after a switch, and after the robot has begun to move

const floor = new Floor(place('floor'));
let charts = null;
let shownCharts = []; // {chart, lines}, line: {stream, column}
let selection = null; // [from, to] while the charts do not follow the run
let cursorTime = null; // instant at the cursor of the charts
let playTime = null; // instant that is played, or shown in place of the newest one
let playing = false;

// -- charts ----------------------------------------------------------------------------------------

const CHANNELS = [['Right wheel', 'rad/s'], ['Left wheel', 'rad/s']];
const TERM_DASHES = [[], [6, 3], [2, 3], [8, 3, 2, 3], [1, 4]];

// Charts of the streams that there are: a recording may have no reference and no terms.
function makeCharts() {
  if (charts) return;
  charts = new ChartGroup(place('charts'), {
    moved: (time) => {
      cursorTime = time;
      place('cursor-time').textContent = time === null ? '' : `cursor at ${timeText(time, 2)}`;
      moved = true;
    },
    selected: (from, to) => { if (from === null) follow(); else selection = [from, to]; changed = true; },
    snap: nearestMeasurement,
    words: timeText,
  });
  const channels = facts.channels || CHANNELS;
  const line = (stream, column, colour, label = colour, look = {}) => ({ stream, column, colour, label, ...look });
  channels.forEach(([title, unit], i) => addChart(title, unit, [
    line('reference', i, 'reference', 'reference', { dash: [6, 4] }),
    line('preview', i, 'preview', 'preview', { dash: [2, 3] }),
    line('odometry', i, 'odometry'),
    line('command', i, 'command', 'command', { dash: [2, 3], style: 'steps' })]));
  const short = (title) => title.split(' ')[0].toLowerCase();
  const error = channels.map(([title], i) =>
    line('error', i, ['right', 'left'][i], short(title), { dash: i ? [6, 3] : [] }));
  const units = channels.map(([, unit]) => unit);
  if (units[0] === units[1]) addChart('Error', units[0], error);
  else error.forEach((each, i) => addChart(`Error, ${each.label}`, units[i], [each]));
  ['right', 'left'].forEach((wheel, i) => addChart(`Terms of the control law, ${wheel} wheel`, 'rad/s²',
    facts.terms.map((name, k) => line('terms', 2 * k + i, name, name, { dash: TERM_DASHES[k] }))));
  markEvents();
  addAgain(facts.added || []);
}

const followsPath = () => Boolean(facts.follows_path) || (facts['parameters/controller'] || [])
  .some(({ name, value }) => name === 'pose.enabled' && value === true);

// A robot that follows a path is shown by its distance from it: its speeds leave those of the path.
function showDistance() {
  if (!followsPath() || shownCharts.some(({ lines }) => lines[0].stream === 'distance')) return;
  const errors = shownCharts.filter(({ lines }) => lines[0].stream === 'error').map(figureOf);
  addChart('Distance from the path', 'mm', [{ stream: 'distance', column: 0, colour: 'c1', label: 'distance' }]);
  if (!errors.length || shownCharts.at(-1).lines[0].stream !== 'distance') return;
  errors[0].before(figureOf(shownCharts.at(-1)));
  for (const each of errors) each.hidden = true;
}

function addChart(title, unit, lines) {
  const derived = { error: 'reference', preview: 'reference', distance: 'reference' };
  const absent = new Set(facts.absent);
  const kept = lines.filter(({ stream }) => !absent.has(stream) && !absent.has(derived[stream]));
  if (kept.some(({ stream }) => stream !== 'command')) {
    const entry = { chart: charts.add(title, unit, [...kept]), lines: kept };
    shownCharts.push(entry);
    // With a mouse, a line is dragged from one chart to another by its legend, too.
    kept.forEach((line, i) => {
      const signal = signals().find(({ stream, column }) => stream === line.stream && column === line.column);
      if (signal) dragged(entry.chart.legend.children[i], signal, ({ pointerType }) => pointerType === 'mouse');
    });
  }
}

// Rows of a stream within a range, and one on each side, so that lines go on beyond the edges.
function rows(name, [from, to]) {
  const kept = streams[name] || { time: [], values: [] };
  const part = [Math.max(0, rowAt(kept.time, from)), rowAt(kept.time, to) + 2];
  return { time: kept.time.slice(...part), values: kept.values.map((column) => column.slice(...part)) };
}

// The reference is sent ahead of its time: what is later than the last measurement is its preview.
function shownStreams(range) {
  const found = {};
  for (const name of ['odometry', 'truth', 'command', 'terms', 'ranges', 'reference']) found[name] = rows(name, range);
  const { time, values } = found.reference;
  const now = rowAt(time, newest()) + 1;
  found.preview = { time: time.slice(Math.max(0, now - 1)), values: values.map((each) => each.slice(Math.max(0, now - 1))) };
  found.reference = { time: time.slice(0, now), values: values.map((each) => each.slice(0, now)) };
  // As in reports: of the true motion where it is known, else of the odometry.
  const motion = streams.truth ? found.truth : found.odometry;
  found.error = { time: motion.time, values: [0, 1].map((i) => motion.time.map((at, row) => {
    const [value, wanted] = [motion.values[i]?.[row] ?? null, valueAt(time, values[i] || [], at)];
    return value === null || wanted === null ? null : value - wanted;
  })) };
  found.distance = distance(motion, time, values);
  return found;
}

// How far the robot is from the place of its reference at the same time, mm.
function distance(motion, time, values) {
  const away = (row, axis) => {
    const [at, wanted] = [motion.values[axis]?.[row] ?? null, valueAt(time, values[axis] || [], motion.time[row])];
    return at === null || wanted === null ? NaN : at - wanted;
  };
  return { time: motion.time, values: [motion.time.map((_, row) => {
    const found = 1000 * Math.hypot(away(row, 2), away(row, 3));
    return Number.isNaN(found) ? null : found;
  })] };
}

function drawCharts() {
  const range = shownRange();
  if (!charts || !range) return;
  showDistance();
  showSignals();
  const found = shownStreams(range);
  const driven = isDriven(found.command);
  for (const { chart, lines } of shownCharts) {
    const tables = lines.map(({ stream, column }) =>
      [found[stream].time, found[stream].values[column] || []]);
    const own = tables.filter((_, i) => (lines[i].unit ?? chart.unit) === chart.unit);
    charts.set(chart, tables, ['error', 'terms'].includes(lines[0].stream) ? limits(own, driven) : null);
  }
  charts.draw(range);
  const over = place('charts').querySelector('.u-over:hover');
  if (playTime !== null && !over) charts.moveTo(playTime);
}

// Whether the robot was commanded to move, and settled, at an instant: what happens while it is
// stopped, while it catches up, and at a switch would make everything else a flat line.
function isDriven({ time, values }) {
  const timesOf = (...kinds) => events.filter(({ kind }) => kinds.includes(kind)).map((each) => each.time);
  const [stops, resumes] = [timesOf('stop'), timesOf('resume')];
  const breaks = [...timesOf('switch'), ...stops, ...resumes];
  const moves = (row) => values.some((column) => column[row]);
  time.forEach((at, row) => { if (row && moves(row) && !moves(row - 1)) breaks.push(at); });
  breaks.sort((a, b) => a - b);
  return (at) => {
    if (time.length && !moves(rowAt(time, at))) return false; // the controller commands rest
    const stop = stops[rowAt(stops, at)]; // the robot stands, whatever the controller commands
    if (stop !== undefined && !(resumes[rowAt(resumes, at)] > stop)) return false;
    const next = rowAt(breaks, at);
    return !(at < breaks[next] + AFTER || at > breaks[next + 1] - BEFORE);
  };
}

function limits(tables, driven) {
  let [low, high, count] = [Infinity, -Infinity, 0];
  for (const [time, column] of tables) {
    const among = time.map(driven);
    column.forEach((value, row) => {
      if (value === null || !among[row]) return;
      [low, high, count] = [Math.min(low, value), Math.max(high, value), count + 1];
    });
  }
  const margin = 0.15 * (high - low);
  return count > 20 && margin > 0 ? [low - margin, high + margin] : null;
}

function nearestMeasurement(time) {
  const { time: times, values } = streams.odometry || { time: [] };
  const row = rowAt(times, time);
  const [before, after] = [times[values?.[0][row] === null ? row - 1 : row], times[row + 1]]; // a null is a gap
  if (before === undefined || after - time < time - before) return after ?? null;
  return before;
}

// -- what is shown -----------------------------------------------------------------------------------

const span = () => Number(place('span').value);

function shownRange() {
  if (newest() === undefined) return null;
  if (selection) return selection;
  if (playTime !== null && span() < Infinity) return [playTime - 0.8 * span(), playTime + 0.2 * span()];
  return [span() < Infinity ? newest() - span() : begin(), newest() + (facts.recording ? 0 : 0.5)];
}

// Show the run as it goes on, or all of a recording.
function follow() {
  selection = playTime = null;
  setPlaying(false);
}

// Show an instant, with what was before and after it.
function seek(time) {
  playTime = Math.min(newest(), Math.max(begin(), time));
  if (selection && !(selection[0] <= playTime && playTime <= selection[1])) {
    const half = 0.5 * (selection[1] - selection[0]);
    selection = [playTime - half, playTime + half];
  }
  changed = moved = true;
}

function setPlaying(now) {
  playing = now && newest() !== undefined;
  if (playing && (playTime === null || playTime >= newest())) seek(begin());
  place('play').textContent = playing ? 'Pause' : 'Play';
  changed = moved = true;
}

place('play').onclick = () => setPlaying(!playing);
place('seek').oninput = () => { setPlaying(false); seek(begin() + Number(place('seek').value) * (newest() - begin())); };
place('hold').onclick = () => { if (selection || playTime !== null) follow(); else selection = shownRange(); changed = true; };
place('span').onchange = () => { selection = null; changed = true; };

document.addEventListener('keydown', (key) => {
  if (key.target.closest('input, select, button, textarea, summary') || key.ctrlKey || key.metaKey) return;
  if (key.key === 'h') place('hold').click();
  if (key.key === 'p' || (key.key === ' ' && facts.recording)) { key.preventDefault(); setPlaying(!playing); }
});

let lastFrame = steady();

// Move on what is played; the end of a live run is the present.
function play() {
  const [now, passed] = [steady(), steady() - lastFrame];
  lastFrame = now;
  if (!playing || newest() === undefined) return;
  const time = playTime + passed * Number(place('rate').value);
  if (time < newest()) seek(time);
  else if (facts.recording) { seek(newest()); setPlaying(false); }
  else follow();
}

function showPlayer() {
  const held = Boolean(selection) || playTime !== null;
  place('hold').setAttribute('aria-pressed', String(held));
  place('hold').textContent = held ? (facts.recording ? 'All' : 'Follow') : 'Hold';
  place('hold').hidden = Boolean(facts.recording) && !held;
  if (newest() === undefined) return;
  const at = playTime ?? (selection ? Math.min(selection[1], newest()) : newest());
  const share = (at - begin()) / (newest() - begin() || 1);
  if (document.activeElement !== place('seek') || playing) place('seek').value = share;
  place('seek').setAttribute('aria-valuetext', timeText(at));
  place('play-time').textContent = timeText(at, 1);
}

// A recording has no commands; all of it is shown, and the cursor moves the robot.
function showRecording() {
  for (const id of ['stop-box', 'drawer']) place(id).hidden = true;
  document.querySelector('main').classList.add('recording');
  if (!place('span').querySelector('[value="Infinity"]')) {
    place('span').prepend(element('option', { value: 'Infinity', textContent: 'all' }));
    place('span').value = 'Infinity';
  }
}

// -- floor -------------------------------------------------------------------------------------------

// The first values of the sample at the instant that is shown; null where a pose is not known.
function sampleOf(name, first, count) {
  const kept = streams[name];
  const at = cursorTime ?? playTime ?? Infinity;
  const row = kept ? Math.max(0, rowAt(kept.time, at)) : 0;
  if (!kept?.time.length) return null;
  const values = kept.values.slice(first, first + count).map((column) => column[row]);
  return values.includes(null) && count === 3 ? null : values;
}

function path(name, look, frame, [from, to]) {
  const { time, values } = rows(name, [from, to]);
  const result = { x: [], y: [], ...look };
  for (let i = 0; i < time.length; i += 2) {
    if (time[i] < from || time[i] > to) continue;
    const pose = [values[2][i], values[3][i], 0];
    const known = !pose.includes(null);
    const [x, y] = known && frame ? compose(frame, pose) : pose;
    result.x.push(known ? x : NaN);
    result.y.push(known ? y : NaN);
  }
  return result;
}

const ON_FLOOR = ['switch', 'stop', 'fault', 'slip']; // events that are marked where the robot was
const PATHS = [
  ['reference', 'reference', { colour: 'reference', dash: [6, 4] }],
  ['preview', 'preview', { colour: 'preview', dash: [2, 3] }],
  ['odometry', 'odometry', { colour: 'odometry' }],
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
  const range = shownRange();
  if (!range) return;
  layBase();
  const truth = sampleOf('truth', 2, 3);
  const odometry = sampleOf('odometry', 2, 3);
  const all = selection || facts.recording ? range : [Math.min(range[0], range[1] - PATH), range[1]];
  const parts = { reference: ['reference', [all[0], Math.min(all[1], newest())]],
    preview: ['reference', [newest(), all[1]]], odometry: ['odometry', all], truth: ['truth', all] };
  const paths = PATHS.filter(([name]) => streams[parts[name][0]]).map(([name, , look]) =>
    path(parts[name][0], look, name === 'truth' ? null : base, parts[name][1]));
  const robot = truth || (odometry && base && compose(base, odometry));
  if (drawnPath) paths.push(drawnPath);
  const marks = events.filter(({ kind, time }) => ON_FLOOR.includes(kind) && all[0] <= time && time <= all[1])
    .map(({ kind, time }) => [placeAt(time), MARKS[kind]]).filter(([at]) => at).map(([at, name]) => [...at, name]);
  floor.draw({ still: isDrawing(), world: facts.world, changes: facts.map_changes, paths, marks, robot, mounts: facts.mounts, reach: facts.reach,
    ranges: sampleOf('ranges', 0, 8), track: facts.robot?.wheel_separation,
    wheel: facts.robot?.wheel_radius });
  if (!robot) return;
  const speeds = sampleOf('odometry', 0, 2);
  const degrees = (((robot[2] * 180) / Math.PI + 180) % 360 + 360) % 360 - 180;
  const motion = facts.channels
    ? speeds.map((each, i) => `${number(each, 2)} ${facts.channels[i][1]}`).join(' and ')
    : `wheels ${speeds.map((each) => number(each, 1)).join(' and ')} rad/s`;
  place('pose').textContent = `x ${number(robot[0], 2)} m, y ${number(robot[1], 2)} m, `
    + `yaw ${number(degrees, 0)}°, ${motion}`;
}

// Where the robot was at an instant, by what is shown as its place.
function placeAt(time) {
  const name = streams.truth ? 'truth' : 'odometry';
  const { time: times, values } = streams[name] || { time: [] };
  const row = rowAt(times, time);
  const pose = values?.slice(2, 5).map((column) => column[row] ?? null);
  if (row < 0 || !pose || pose.includes(null) || (name === 'odometry' && !base)) return null;
  return (name === 'truth' ? pose : compose(base, pose)).slice(0, 2);
}

function showFloorLegend() {
  const shown = PATHS.filter(([name]) => streams[name === 'preview' ? 'reference' : name]);
  place('floor-legend').replaceChildren(...shown.map(([, label, { colour: name, dash }]) =>
    element('li', {}, sample(name, dash), label)),
  ...ON_FLOOR.filter((each) => events.some(({ kind }) => kind === each)).map((kind) =>
    element('li', {}, dot(MARKS[kind]), kind)),
  ...(facts.world?.patches.length ? [element('li', {}, dot('patch'), 'slippery floor')] : []),
  ...(streams.ranges ? [element('li', {}, sample('ray'), 'range'),
    element('li', {}, sample('ray', [2, 4]), 'nothing within range')] : []));
}

setInterval(() => {
  play();
  if (document.hidden) return;
  if (changed) {
    fillCards();
    showPlayer();
    drawCharts();
    showFloorLegend();
  }
  if (changed || moved) drawFloor();
  changed = moved = false;
}, FRAME);
theme.addEventListener('change', () => { changed = true; });
