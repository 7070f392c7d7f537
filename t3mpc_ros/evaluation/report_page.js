// Copyright 2026 The t3mpc_ros developers
// SPDX-License-Identifier: Apache-2.0
// Draws the charts of a report from the data that the page contains.
'use strict';

const TICK = 1e-5; // s
const NEAR = 3; // s shown before and after an event
const EVENTS = { switch: 'switch', stop: 'stopped', stall: 'c4', gap: 'soft', jump: 'c5', slip: 'slip' }; // marks

const place = (id) => document.getElementById(id);
const data = JSON.parse(place('data').textContent);
const planes = [];
let charts = null;
let span = null; // the whole time
let range = null; // the selected part of it, or null

async function unpack() {
  const bytes = Uint8Array.from(atob(data.packed), (each) => each.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream('deflate'));
  const content = new Uint8Array(await new Response(stream).arrayBuffer());
  let offset = 0;
  data.columns = data.columns.map(([kind, count]) => {
    const size = kind === 't' ? 8 : 4;
    const values = kind === 't' ? new Float64Array(count) : new Float32Array(count);
    const raw = new Uint8Array(values.buffer);
    for (let k = 0; k < size; k++) {
      for (let i = 0; i < count; i++) raw[i * size + k] = content[offset++];
    }
    if (kind !== 't') return Array.from(values, (each) => (Number.isFinite(each) ? each : null));
    let ticks = 0;
    return Array.from(values, (each) => { ticks += each; return ticks * TICK; });
  });
}

function show(text) {
  const [from, to] = range || span;
  place('range').textContent = text || `${number(from, 2)} to ${number(to, 2)} s`;
}

// Show a part of the time, or all of it.
function select(from, to) {
  range = from === null || to - from >= span[1] - span[0] ? null
    : [Math.max(span[0], from), Math.min(span[1], to)];
  for (const chart of charts.charts) chart.limits = range ? null : chart.extent;
  charts.draw(range || span);
  drawPlanes(null);
  show();
}

function addChart(id, { title, unit, lines, summary, extent }) {
  const box = place(id);
  const made = charts.add(title, unit, lines, { box, summary: `${title}. ${summary}` });
  const tables = [];
  let last = -1;
  for (const { time, value } of lines) {
    if (time !== last) tables.push([data.columns[time]]);
    tables.at(-1).push(data.columns[value]);
    last = time;
  }
  charts.set(made, tables);
  made.extent = extent;
  box.querySelector('h3').append(element('button', { type: 'button', textContent: 'CSV',
    title: 'Download the data shown', ariaLabel: `Download the data of ${title} as CSV`,
    onclick: () => download(made) }));
}

// The rows of a chart that are shown, as a file.
function download(chart) {
  const [from, to] = range || span;
  const rows = [['time_s', ...chart.series.map((each) => `${each.label} (${chart.unit})`)]
    .map((each) => `"${each.replaceAll('"', '""')}"`).join(',')];
  chart.data[0].forEach((time, i) => {
    if (time < from || time > to) return;
    rows.push([+time.toFixed(5), ...chart.data.slice(1).map((column) => column[i] ?? '')].join(','));
  });
  const link = element('a', { download: `${chart.title.replace(/[^A-Za-z0-9]+/g, '_')}.csv`,
    href: URL.createObjectURL(new Blob([`${rows.join('\n')}\n`], { type: 'text/csv' })) });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
}

function addPlane(id, { unit, curves, summary, title, world, marks }) {
  const canvas = element('canvas', { role: 'img', ariaLabel: `${title}. ${summary}` });
  const legend = element('ul', { className: 'legend' });
  for (const { label, colour: name, dash } of curves) {
    legend.append(element('li', {}, sample(name, dash), label));
  }
  for (const name of new Set(marks.map((mark) => mark.at(-1)))) {
    const [kind] = Object.entries(EVENTS).find((each) => each[1] === name);
    legend.append(element('li', {}, dot(name), kind));
  }
  if (world?.patches.length) legend.append(element('li', {}, dot('patch'), 'slippery floor'));
  place(id).querySelector('h3').after(canvas, legend);
  const lines = curves.map(({ colour: name, dash, time, x, y }) => ({ colour: name, dash,
    time: data.columns[time], x: data.columns[x], y: data.columns[y] }));
  planes.push({ floor: new Floor(canvas, unit), lines, world, marks });
}

// Draw the curves of the selected time, with a point at the cursor.
function drawPlanes(cursor) {
  const [from, to] = range || span;
  for (const { floor, lines, world, marks } of planes) {
    const points = [];
    const paths = lines.map(({ time, x, y, ...look }) => {
      let [first, last] = [time.findIndex((each) => each >= from), time.findLastIndex((each) => each <= to)];
      if (first < 0) [first, last] = [0, -1];
      const row = cursor === null ? -1 : time.findLastIndex((each) => each <= cursor);
      if (row >= 0 && Number.isFinite(x[row])) points.push([x[row], y[row], look.colour]);
      return { ...look, x: x.slice(first, last + 1), y: y.slice(first, last + 1) };
    });
    const marked = marks.filter(([time]) => time >= from && time <= to)
      .map(([, ...mark]) => mark);
    floor.view = null;
    floor.draw({ world, paths, marks: [...marked, ...points] });
  }
}

async function start() {
  await unpack();
  charts = new ChartGroup(document.querySelector('main'), {
    moved: (time) => {
      drawPlanes(time);
      show(time === null ? '' : `cursor at ${number(time, 2)} s`);
    },
    selected: select,
  });
  charts.marks = data.events.filter(([, kind]) => EVENTS[kind])
    .map(([time, kind]) => ({ time, colour: EVENTS[kind] }));
  for (const [id, plane] of Object.entries(data.planes)) addPlane(id, plane);
  for (const [id, chart] of Object.entries(data.charts)) addChart(id, chart);
  const times = charts.charts.map((each) => each.data[0]).filter((each) => each.length);
  if (!times.length) times.push(...planes.flatMap(({ lines }) => lines.map((each) => each.time)));
  span = [Math.min(...times.map((each) => each[0])), Math.max(...times.map((each) => each.at(-1)))];
  if (!(span[1] > span[0])) span[1] = span[0] + 1;
  select(null);
  for (const label of document.querySelectorAll('[data-time]')) {
    const time = Number(label.dataset.time);
    const button = element('button', { type: 'button', textContent: label.textContent,
      title: 'Show this part of the charts' });
    button.onclick = () => {
      select(time - NEAR, time + NEAR);
      queueMicrotask(() => charts.moveTo(time)); // after the charts have their new scales
    };
    label.replaceChildren(button);
  }
  place('all').onclick = () => select(null);
  place('tools').hidden = charts.charts.length === 0;
  new ResizeObserver(() => drawPlanes(null)).observe(document.querySelector('main'));
  theme.addEventListener('change', () => drawPlanes(null));
  // Paper is white, whatever the scheme of the screen.
  for (const kind of ['beforeprint', 'afterprint']) {
    addEventListener(kind, () => {
      document.documentElement.classList.toggle('printed', kind === 'beforeprint');
      charts.rebuild();
      drawPlanes(null);
    });
  }
}

start();
