// Copyright 2026 The t3mpc_ros developers
// SPDX-License-Identifier: Apache-2.0
// Charts with one shared cursor, and the map of the floor.
'use strict';

const theme = window.matchMedia('(prefers-color-scheme: dark)');

function colour(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
}

function element(name, properties = {}, ...children) {
  const made = Object.assign(document.createElement(name), properties);
  made.append(...children);
  return made;
}

// A short piece of line as it is drawn in a chart: lines differ by their dashes, too.
function sample(name, dash = []) {
  const picture = document.createElementNS('http://www.w3.org/2000/svg', 'svg');
  picture.setAttribute('viewBox', '0 0 24 10');
  picture.setAttribute('aria-hidden', 'true');
  const line = document.createElementNS('http://www.w3.org/2000/svg', 'line');
  const look = { x1: 0, y1: 5, x2: 24, y2: 5, stroke: `var(--${name})`, 'stroke-width': 3,
    'stroke-dasharray': dash.join(' ') };
  for (const [key, value] of Object.entries(look)) line.setAttribute(key, value);
  picture.append(line);
  return picture;
}

function number(value, digits = 3) {
  return value === null || value === undefined ? '–' : value.toFixed(digits).replace('-', '−');
}

// Values of a column at other times, by linear interpolation; null outside.
function interpolate(times, values, at) {
  const result = new Array(at.length).fill(null);
  let k = 0;
  for (let i = 0; i < at.length; i++) {
    while (k + 1 < times.length && times[k + 1] < at[i]) k++;
    if (k + 1 >= times.length || at[i] < times[k]) continue;
    const [a, b] = [values[k], values[k + 1]];
    if (a === null || b === null) continue;
    const part = (at[i] - times[k]) / (times[k + 1] - times[k] || 1);
    result[i] = a + part * (b - a);
  }
  return result;
}

// Charts over one time axis: a cursor, a selected span and the colours are common to all.
class ChartGroup {
  // place: element that gets the charts; moved(time or null): called when the cursor moves;
  // selected(from, to): called when a span is selected, (null) to undo it; spanGaps: whether a
  // null is skipped, or seen as a gap.
  constructor(place, { moved = () => {}, selected = () => {}, spanGaps = true } = {}) {
    this.place = place;
    this.moved = moved;
    this.selected = selected;
    this.spanGaps = spanGaps;
    this.charts = [];
    this.key = `t3mpc-${Math.random()}`;
    this.marks = [];
    new ResizeObserver(() => this.resize()).observe(place);
    theme.addEventListener('change', () => this.rebuild());
  }

  // series: [{label, colour, dash, style}], title and unit in words; box: a figure with a title,
  // which gets the chart, and summary: what is seen in it.
  add(title, unit, series, { box, summary } = {}) {
    const legend = element('div', { className: 'chart-legend' });
    const plot = element('div', { role: 'img', tabIndex: 0,
      ariaLabel: summary || `${title}, ${unit}, over time` });
    if (box) {
      box.querySelector('h3').after(plot, legend);
    } else {
      this.place.append(element('figure', { className: 'chart' },
        element('h3', { textContent: `${title} (${unit})` }), plot, legend));
    }
    const chart = { title, unit, series, plot, legend, data: [[], ...series.map(() => [])] };
    chart.values = series.map((each) => {
      const value = element('b', { textContent: '–' });
      legend.append(element('span', {}, sample(each.colour, each.dash), `${each.label} `, value));
      return value;
    });
    plot.addEventListener('keydown', (key) => this.press(chart, key));
    this.charts.push(chart);
    this.build(chart);
    return chart;
  }

  build(chart) {
    chart.uplot?.destroy();
    const axis = { stroke: colour('ink'), grid: { stroke: colour('line'), width: 1 },
      ticks: { stroke: colour('line') }, font: '12px system-ui, sans-serif' };
    chart.uplot = new uPlot({
      width: Math.max(200, chart.plot.clientWidth), height: 160,
      legend: { show: false }, cursor: { sync: { key: this.key }, y: false, drag: { x: true, y: false }, points: { size: 6 } },
      scales: { x: { time: false, range: (u, low, high) => this.range || [low, high] } },
      axes: [{ ...axis, size: 30, values: (u, ticks) => ticks.map((each) => `${+each.toFixed(2)} s`) },
        { ...axis, size: 52 }],
      series: [{}, ...chart.series.map((each) => ({ label: each.label, stroke: colour(each.colour),
        dash: each.dash, width: 1.6, spanGaps: this.spanGaps, points: { show: false },
        ...style(each.style, colour(each.colour)) }))],
      hooks: {
        setCursor: [(u) => this.showCursor(chart, u)],
        setSelect: [(u) => {
          if (u.select.width > 4) {
            this.selected(u.posToVal(u.select.left, 'x'),
              u.posToVal(u.select.left + u.select.width, 'x'));
          }
          u.setSelect({ left: 0, width: 0, top: 0, height: 0 }, false);
        }],
        draw: [(u) => this.drawMarks(u)],
      },
    }, chart.data, chart.plot);
    chart.uplot.over.addEventListener('dblclick', () => this.selected(null));
  }

  // tables: one [times, column, …] for each stream; columns in the order of the series.
  set(chart, tables) {
    chart.data = tables.length > 1 ? uPlot.join(tables) : tables[0];
  }

  // Draw all charts from one instant to another; null: everything.
  draw(range) {
    this.range = range;
    for (const chart of this.charts) {
      chart.uplot.setData(chart.data);
      if (chart.uplot.cursor.left < 0) this.showLast(chart);
    }
  }

  drawMarks(u) {
    const context = u.ctx;
    context.save();
    context.setLineDash([4, 4]);
    for (const mark of this.marks) {
      const x = Math.round(u.valToPos(mark.time, 'x', true));
      if (x < u.bbox.left || x > u.bbox.left + u.bbox.width) continue;
      context.strokeStyle = colour(mark.colour);
      context.beginPath();
      context.moveTo(x, u.bbox.top);
      context.lineTo(x, u.bbox.top + u.bbox.height);
      context.stroke();
    }
    context.restore();
  }

  showCursor(chart, u) {
    const row = u.cursor.idx;
    if (row === null || row === undefined || u.cursor.left < 0) {
      this.showLast(chart);
      if (chart === this.charts[0]) this.moved(null);
      return;
    }
    chart.series.forEach((each, i) => {
      chart.values[i].textContent = number(nearest(chart.data[i + 1], row));
    });
    if (chart === this.charts[0]) this.moved(chart.data[0][row]);
  }

  showLast(chart) {
    chart.series.forEach((each, i) => {
      const column = chart.data[i + 1];
      chart.values[i].textContent = number(nearest(column, column.length - 1));
    });
  }

  // Put the cursor of all charts at an instant.
  moveTo(time) {
    for (const { uplot } of this.charts) {
      uplot.setCursor({ left: uplot.valToPos(time, 'x'), top: 0 });
    }
  }

  // Arrows move the cursor, + and - zoom about it, 0 shows everything.
  press(chart, key) {
    const { cursor, scales: { x: { min, max } } } = chart.uplot;
    const at = cursor.left >= 0 ? chart.uplot.posToVal(cursor.left, 'x') : 0.5 * (min + max);
    const step = { ArrowLeft: -0.01, ArrowRight: 0.01 }[key.key];
    const zoom = { '+': 0.5, '-': 2 }[key.key];
    if (step) this.moveTo(Math.min(max, Math.max(min, at + step * (max - min))));
    else if (zoom) this.selected(at - zoom * (at - min), at + zoom * (max - at));
    else if (key.key === '0') this.selected(null);
    else return;
    key.preventDefault();
  }

  resize() {
    for (const { uplot, plot } of this.charts) {
      uplot.setSize({ width: Math.max(200, plot.clientWidth), height: 160 });
    }
  }

  rebuild() {
    for (const chart of this.charts) this.build(chart);
    this.draw(this.range);
  }
}

// How a line is drawn: joined by straight lines if nothing else is said.
function style(name, stroke) {
  if (name === 'steps') return { paths: uPlot.paths.stepped({ align: 1 }) };
  if (name === 'points') return { paths: () => null, points: { show: true, size: 3, width: 0, fill: stroke } };
  return {};
}

// The last value up to a row: joined streams have rows without a value.
function nearest(column, row) {
  for (let i = row; i >= 0 && i > row - 40; i--) {
    if (column[i] !== null && column[i] !== undefined) return column[i];
  }
  return null;
}

// Pose b as seen from the frame in which a is the origin, and back.
function compose([x, y, yaw], [u, v, turn]) {
  const [c, s] = [Math.cos(yaw), Math.sin(yaw)];
  return [x + c * u - s * v, y + s * u + c * v, yaw + turn];
}

function inverse([x, y, yaw]) {
  const [c, s] = [Math.cos(yaw), Math.sin(yaw)];
  return [-c * x - s * y, s * x - c * y, -yaw];
}

// Map of a plane, x to the right and y up: of the floor in metres, with walls and robot, or of two
// quantities with one unit.
class Floor {
  constructor(canvas, unit = 'm') {
    this.canvas = canvas;
    this.unit = unit;
    this.view = null;
  }

  // scene: {world, paths: [{x, y, colour, dash}], marks: [[x, y, colour]], robot: [x, y, yaw] or
  // null, mounts, ranges, track (m)}; NaN interrupts a path
  draw(scene) {
    const canvas = this.canvas;
    const ratio = window.devicePixelRatio || 1;
    const size = Math.round(canvas.clientWidth * ratio);
    if (canvas.width !== size) canvas.width = canvas.height = size;
    const context = canvas.getContext('2d');
    this.fit(scene);
    const [cx, cy, half] = this.view;
    const scale = size / (2 * half);
    const at = (x, y) => [(x - cx + half) * scale, (cy + half - y) * scale];
    context.fillStyle = colour('paper');
    context.fillRect(0, 0, size, size);
    this.grid(context, at, ratio);
    this.obstacles(context, scene.world, at, scale, ratio);
    for (const path of scene.paths) {
      context.strokeStyle = colour(path.colour);
      context.lineWidth = 1.8 * ratio;
      context.setLineDash((path.dash || []).map((each) => each * ratio));
      context.beginPath();
      let drawn = false;
      path.x.forEach((x, i) => {
        const known = Number.isFinite(x);
        if (known) context[drawn ? 'lineTo' : 'moveTo'](...at(x, path.y[i]));
        drawn = known;
      });
      context.stroke();
    }
    context.setLineDash([]);
    for (const [x, y, name] of scene.marks || []) {
      context.fillStyle = colour(name);
      disc(context, ...at(x, y), 4.5 * ratio);
    }
    if (scene.robot) this.robot(context, scene, at, scale, ratio);
  }

  fit(scene) {
    let [left, right, bottom, top] = [Infinity, -Infinity, Infinity, -Infinity];
    const include = (x, y) => {
      if (!Number.isFinite(x)) return;
      left = Math.min(left, x); right = Math.max(right, x);
      bottom = Math.min(bottom, y); top = Math.max(top, y);
    };
    for (const [ax, ay, bx, by] of scene.world?.segments || []) { include(ax, ay); include(bx, by); }
    for (const path of scene.paths) path.x.forEach((x, i) => include(x, path.y[i]));
    if (scene.robot) include(scene.robot[0], scene.robot[1]);
    if (left > right) include(0, 0);
    const half = Math.max(0.5, 0.55 * Math.max(right - left, top - bottom) + 0.1);
    const wanted = [(left + right) / 2, (bottom + top) / 2, half];
    // The view follows slowly, so that the picture rests while the robot moves.
    this.view = this.view && half < 4 * this.view[2] && half > 0.25 * this.view[2]
      ? this.view.map((old, i) => old + 0.15 * (wanted[i] - old)) : wanted;
  }

  grid(context, at, ratio) {
    const [cx, cy, half] = this.view;
    const least = (110 * ratio * half) / this.canvas.width;
    const decade = 10 ** Math.floor(Math.log10(least));
    const step = decade * [1, 2, 5, 10].find((each) => each * decade >= least);
    context.strokeStyle = colour('line');
    context.fillStyle = colour('soft');
    context.lineWidth = ratio;
    context.font = `${11 * ratio}px system-ui, sans-serif`;
    for (let k = Math.ceil((cx - half) / step); k * step <= cx + half; k++) {
      const [x] = at(k * step, cy);
      line(context, x, 0, x, this.canvas.height);
      context.fillText(`${+(k * step).toFixed(2)} ${this.unit}`, x + 3 * ratio, this.canvas.height - 4 * ratio);
    }
    for (let k = Math.ceil((cy - half) / step); k * step <= cy + half; k++) {
      const [, y] = at(cx, k * step);
      line(context, 0, y, this.canvas.width, y);
    }
  }

  obstacles(context, world, at, scale, ratio) {
    if (!world) return;
    context.fillStyle = colour('patch');
    for (const [x, y, radius] of world.patches) disc(context, ...at(x, y), radius * scale);
    context.fillStyle = colour('wall');
    for (const [x, y, radius] of world.circles) disc(context, ...at(x, y), radius * scale);
    context.strokeStyle = colour('wall');
    context.lineWidth = 3 * ratio;
    for (const [ax, ay, bx, by] of world.segments) line(context, ...at(ax, ay), ...at(bx, by));
  }

  robot(context, { robot, mounts, ranges, track }, at, scale, ratio) {
    context.strokeStyle = colour('ray');
    context.lineWidth = 1.2 * ratio;
    (ranges || []).forEach((distance, i) => {
      if (distance === null || !mounts?.[i]) return;
      const from = compose(robot, mounts[i]);
      const to = compose(from, [distance, 0, 0]);
      line(context, ...at(from[0], from[1]), ...at(to[0], to[1]));
    });
    const [x, y] = at(robot[0], robot[1]);
    const radius = Math.max(6 * ratio, 0.6 * (track || 0.15) * scale);
    context.fillStyle = colour('accent');
    disc(context, x, y, radius);
    const [hx, hy] = [x + 1.7 * radius * Math.cos(robot[2]), y - 1.7 * radius * Math.sin(robot[2])];
    context.strokeStyle = colour('ink');
    context.lineWidth = 3 * ratio;
    line(context, x, y, hx, hy);
  }
}

function line(context, ax, ay, bx, by) {
  context.beginPath();
  context.moveTo(ax, ay);
  context.lineTo(bx, by);
  context.stroke();
}

function disc(context, x, y, radius) {
  context.beginPath();
  context.arc(x, y, radius, 0, 2 * Math.PI);
  context.fill();
}
