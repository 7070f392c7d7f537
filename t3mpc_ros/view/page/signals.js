// Copyright 2026 The t3mpc_ros developers
// SPDX-License-Identifier: Apache-2.0
// Signals that a person puts into a chart: dragged there, or chosen, and then the chart.
'use strict';

const REACH = 6; // px that a pointer moves before it drags
const EDGE = 60; // px from the edges of the window within which a drag scrolls it
const COLOURS = ['c4', 'c3', 'c2', 'c5', 'c1']; // of lines that are added
const POSE = [['x', 'm'], ['y', 'm'], ['yaw', 'rad']];

let chosen = null; // the signal that waits for its chart
let drag = null; // {pointer, signal, from: [x, y], ghost}
const added = []; // [title of the chart, name of the signal]

// Every signal of a run as a line of a chart, whether the run has it or not.
function signals() {
  const channels = facts.channels || CHANNELS;
  const found = [];
  const put = (stream, column, name, unit) => found.push({ stream, column, name, label: name, unit });
  for (const [stream, name] of [['reference', 'reference'], ['odometry', 'odometry'], ['truth', 'true'],
    ['command', 'command'], ['error', 'error']]) {
    channels.forEach(([title, unit], i) => put(stream, i, `${title}, ${name}`, unit));
  }
  for (const [stream, name] of [['reference', 'reference'], ['odometry', 'odometry'], ['truth', 'true']]) {
    POSE.forEach(([axis, unit], i) => put(stream, 2 + i, `${axis}, ${name}`, unit));
  }
  (facts.terms || []).forEach((term, k) => ['right', 'left'].forEach((wheel, i) =>
    put('terms', 2 * k + i, `${term} term, ${wheel} wheel`, 'rad/s²')));
  (facts.sensors || []).forEach((sensor, i) => put('ranges', i, `range ${sensor.replaceAll('_', ' ')}`, 'm'));
  return found;
}

function isThere({ stream, column }) {
  if (stream === 'error') return isThere({ stream: 'reference', column }) && isThere({ stream: 'odometry', column });
  return Boolean(streams[stream]?.values[column]?.some((each) => each !== null));
}

let listed = '';

function showSignals() {
  const present = signals().filter(isThere);
  const names = present.map(({ name }) => name).join();
  if (names === listed || drag) return;
  listed = names;
  place('signals-box').hidden = !charts;
  place('signals').replaceChildren(...present.map((signal) => {
    const button = element('button', { type: 'button', textContent: signal.name, onclick: () => choose(signal) });
    button.setAttribute('aria-pressed', 'false');
    dragged(button, signal);
    return element('li', {}, button);
  }));
}

const say = (text) => { place('signal-text').textContent = text; };

// -- chosen, then the chart ------------------------------------------------------------------------

function choose(signal) {
  chosen = chosen?.name === signal.name ? null : signal;
  for (const { firstChild: button } of place('signals').children) {
    button.setAttribute('aria-pressed', String(button.textContent === chosen?.name));
  }
  for (const entry of shownCharts) {
    entry.here?.remove();
    entry.here = chosen && element('button', { type: 'button', className: 'here',
      textContent: `Add ${chosen.name} here`, onclick: () => { addSignal(entry, signal); choose(signal); } });
    if (chosen) figureOf(entry).querySelector('h3').after(entry.here);
  }
  if (chosen) say(`${chosen.name}: choose a chart`);
}

// -- dragged ---------------------------------------------------------------------------------------

function dragged(source, signal, accepts = () => true) {
  source.addEventListener('pointerdown', (event) => {
    if (drag || event.button || !accepts(event)) return;
    drag = { pointer: event.pointerId, signal, from: [event.clientX, event.clientY], ghost: null };
    source.setPointerCapture(event.pointerId);
  });
  source.addEventListener('pointermove', (event) => {
    if (drag?.pointer !== event.pointerId) return;
    const way = Math.hypot(event.clientX - drag.from[0], event.clientY - drag.from[1]);
    if (!drag.ghost && way < REACH) return;
    drag.ghost ??= document.body.appendChild(element('span', { id: 'ghost', textContent: signal.name }));
    drag.ghost.style.left = `${event.clientX + 8}px`;
    drag.ghost.style.top = `${event.clientY + 8}px`;
    if (event.clientY > innerHeight - EDGE) scrollBy(0, EDGE / 4);
    if (event.clientY < place('banner').clientHeight + EDGE) scrollBy(0, -EDGE / 4);
    markTarget(chartAt(event));
  });
  source.addEventListener('pointerup', (event) => {
    if (drag?.pointer !== event.pointerId) return;
    const target = drag.ghost && chartAt(event);
    if (drag.ghost) noClick(source);
    endDrag();
    if (target) addSignal(target, signal);
  });
  source.addEventListener('pointercancel', endDrag);
  source.addEventListener('lostpointercapture', endDrag);
}

// A mouse clicks where a drag ends.
function noClick(source) {
  const swallow = (click) => click.stopImmediatePropagation();
  source.addEventListener('click', swallow, { capture: true });
  setTimeout(() => source.removeEventListener('click', swallow, { capture: true }));
}

function chartAt({ clientX, clientY }) {
  const figure = document.elementFromPoint(clientX, clientY)?.closest('figure.chart');
  return shownCharts.find((entry) => figureOf(entry) === figure);
}

const figureOf = ({ chart }) => chart.plot.closest('figure');

function markTarget(target) {
  for (const entry of shownCharts) figureOf(entry).classList.toggle('target', entry === target);
}

function endDrag() {
  drag?.ghost?.remove();
  drag = null;
  markTarget(null);
}

document.addEventListener('keydown', (key) => {
  if (key.key !== 'Escape') return;
  endDrag();
  if (chosen) choose(chosen);
});

// -- the line --------------------------------------------------------------------------------------

function addSignal(entry, signal) {
  const { chart, lines } = entry;
  const units = new Set([chart.unit, ...chart.series.map(({ unit }) => unit ?? chart.unit)]);
  if (lines.some(({ stream, column }) => stream === signal.stream && column === signal.column)) {
    say(`${chart.title} has ${signal.name} already`);
    return;
  }
  if (!units.has(signal.unit) && units.size > 1) {
    say(`${chart.title} has two units already: ${[...units].join(' and ')}`);
    return;
  }
  const used = new Set(lines.map(({ colour: name }) => name));
  const line = { ...signal, colour: COLOURS.find((name) => !used.has(name)) ?? 'ink',
    style: signal.stream === 'command' ? 'steps' : undefined };
  const mark = [chart.title, signal.name];
  added.push(mark);
  lines.push(line);
  charts.extend(chart, line, () => {
    added.splice(added.indexOf(mark), 1);
    lines.splice(lines.indexOf(line), 1);
    say(`${signal.name} is no longer in ${chart.title}`);
    changed = true;
  });
  say(`${signal.name} is in ${chart.title}`);
  changed = true;
}

// What another page had added, as far as this one has its charts.
function addAgain(marks) {
  const known = signals();
  for (const [title, name] of marks) {
    const [entry, signal] = [shownCharts.find(({ chart }) => chart.title === title), known.find((each) => each.name === name)];
    if (entry && signal) addSignal(entry, signal);
  }
}
