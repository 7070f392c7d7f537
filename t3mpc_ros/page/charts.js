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
  return shape('line', { x1: 0, y1: 5, x2: 24, y2: 5, stroke: `var(--${name})`, 'stroke-width': 3,
    'stroke-dasharray': dash.join(' ') });
}

// A point as on the floor.
const dot = (name) => shape('circle', { cx: 12, cy: 5, r: 4.5, fill: `var(--${name})` });

function shape(kind, look) {
  const picture = document.createElementNS('http://www.w3.org/2000/svg', 'svg');
  picture.setAttribute('viewBox', '0 0 24 10');
  picture.setAttribute('aria-hidden', 'true');
  const drawn = document.createElementNS('http://www.w3.org/2000/svg', kind);
  for (const [key, value] of Object.entries(look)) drawn.setAttribute(key, value);
  picture.append(drawn);
  return picture;
}

function number(value, digits = 3) {
  return value === null || value === undefined ? '–' : value.toFixed(digits).replace('-', '−');
}

// Row of the last time up to an instant, -1 before the first one.
function rowAt(times, at) {
  let [low, high] = [0, times.length];
  while (low < high) {
    const middle = (low + high) >> 1;
    if (times[middle] <= at) low = middle + 1; else high = middle;
  }
  return low - 1;
}

const seconds = (time, digits = 2) => `${+time.toFixed(digits)} s`;

// Charts over one time axis: a cursor, a selected span and the colours are common to all. A null
// interrupts a line.
class ChartGroup {
  // place: element that gets the charts; moved(time or null): called when the cursor moves;
  // selected(from, to): called when a span is selected, (null) to undo it; snap(time): the instant
  // that the cursor shows there, else that of the nearest row; words(time): text of a time.
  constructor(place, { moved = () => {}, selected = () => {}, snap = null, words = seconds } = {}) {
    this.place = place;
    this.moved = moved;
    this.selected = selected;
    this.snap = snap;
    this.words = words;
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
    const empty = [[], ...series.map(() => [])];
    const chart = { title, unit, series, plot, legend, tables: [empty], data: empty, limits: null };
    chart.values = series.map((each) => {
      const value = element('b', { textContent: '–' });
      legend.append(legendEntry(each, value));
      return value;
    });
    plot.addEventListener('keydown', (key) => this.press(chart, key));
    this.charts.push(chart);
    this.build(chart);
    return chart;
  }

  // Add a line to a chart; one of another unit has an axis of its own. removed(): called when it
  // is taken out again by its button.
  extend(chart, series, removed = () => {}) {
    const value = element('b', { textContent: '–' });
    const made = legendEntry(series, value);
    const change = (act) => {
      act();
      chart.tables = [[[], ...chart.series.map(() => [])]];
      [chart.data] = chart.tables;
      this.build(chart);
    };
    made.append(element('button', { type: 'button', className: 'remove', textContent: '×',
      ariaLabel: `Remove ${series.label}`, onclick: () => {
        made.remove();
        change(() => {
          const row = chart.series.indexOf(series);
          chart.series.splice(row, 1);
          chart.values.splice(row, 1);
        });
        removed();
      } }));
    chart.legend.append(made);
    change(() => {
      chart.series.push(series);
      chart.values.push(value);
    });
  }

  build(chart) {
    chart.uplot?.destroy();
    const scaleOf = ({ unit = chart.unit }) => (unit === chart.unit ? 'y' : 'other');
    const other = chart.series.find((each) => scaleOf(each) === 'other');
    const whole = (u, low, high) => (low === null ? [low, high] : uPlot.rangeNum(low, high, 0.1, true));
    const axis = { stroke: colour('ink'), grid: { stroke: colour('line'), width: 1 },
      ticks: { stroke: colour('line') }, font: '12px system-ui, sans-serif' };
    chart.uplot = new uPlot({
      width: Math.max(200, chart.plot.clientWidth), height: 160,
      legend: { show: false }, cursor: { sync: { key: this.key }, y: false, drag: { x: true, y: false }, points: { size: 6 } },
      scales: { x: { time: false, range: (u, low, high) => this.range || [low, high] },
        y: { range: (u, low, high) => chart.limits || whole(u, low, high) }, other: { range: whole } },
      axes: [{ ...axis, size: 30, space: 70, values: (u, ticks) => ticks.map((each) => this.words(each)) },
        { ...axis, size: 52 },
        ...(other ? [{ ...axis, scale: 'other', side: 1, size: 52, grid: { show: false },
          label: other.unit, labelSize: 18, labelGap: 0, labelFont: axis.font }] : [])],
      series: [{}, ...chart.series.map((each) => ({ label: each.label, scale: scaleOf(each), stroke: colour(each.colour),
        dash: each.dash, width: 1.6, points: { show: false },
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

  // tables: one [times, column, …] for each stream; columns in the order of the series. limits:
  // lowest and highest value that is shown, null for all of them.
  set(chart, tables, limits = null) {
    chart.tables = tables;
    chart.data = tables.length > 1 ? uPlot.join(tables) : tables[0];
    chart.limits = limits;
  }

  // Draw all charts from one instant to another; null: everything.
  draw(range) {
    this.range = range;
    for (const chart of this.charts) {
      chart.uplot.setData(chart.data);
      this.showValues(chart);
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

  // The instant that the cursor of a chart shows, null without one.
  instant({ uplot: { cursor, data, posToVal } }) {
    if (cursor.left < 0 || cursor.idx === null || cursor.idx === undefined) return null;
    return this.snap ? this.snap(posToVal(cursor.left, 'x')) : data[0][cursor.idx];
  }

  showCursor(chart, u) {
    if (!chart.uplot) return; // while it is being made
    this.showValues(chart);
    if (chart === this.charts[0]) this.moved(this.instant(chart));
  }

  // The legend says where the lines are at the cursor: all of them at the same instant.
  showValues(chart) {
    const time = this.instant(chart);
    const reach = 0.005 * (chart.uplot.scales.x.max - chart.uplot.scales.x.min);
    let i = 0;
    for (const [times, ...columns] of chart.tables) {
      for (const column of columns) {
        const value = time === null ? null : valueAt(times, column, time, chart.series[i].style, reach);
        chart.values[i++].textContent = number(value);
      }
    }
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

// A line of a legend, and its value.
function legendEntry({ colour: name, dash, label }, value) {
  return element('span', {}, sample(name, dash), `${label} `, value);
}

// How a line is drawn: joined by straight lines if nothing else is said.
function style(name, stroke) {
  if (name === 'steps') return { paths: uPlot.paths.stepped({ align: 1 }) };
  if (name === 'points') return { paths: () => null, points: { show: true, size: 3, width: 0, fill: stroke } };
  return {};
}

// Where a line of a style is at an instant; null where there is none. A point counts within reach.
function valueAt(times, column, at, name, reach = 0) {
  const row = rowAt(times, at);
  const [before, after] = [column[row] ?? null, column[row + 1] ?? null];
  if (name === 'points') {
    const near = [row, row + 1].filter((each) => Math.abs(times[each] - at) <= reach)
      .sort((a, b) => Math.abs(times[a] - at) - Math.abs(times[b] - at));
    return near.length ? column[near[0]] ?? null : null;
  }
  if (row < 0 || (row === times.length - 1 && times[row] < at)) return null;
  if (name === 'steps' || times[row] === at) return before;
  if (before === null || after === null) return null;
  return before + ((at - times[row]) / (times[row + 1] - times[row])) * (after - before);
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
  // null, changes: [[x, y, size, kind, present]] of the map, mounts: [[x, y, yaw]] of the range
  // sensors, ranges, reach, track, wheel (radius) (m)};
  // NaN interrupts a path; still: whether the view stays as it is
  draw(scene) {
    const canvas = this.canvas;
    const ratio = window.devicePixelRatio || 1;
    const size = Math.round(canvas.clientWidth * ratio);
    if (canvas.width !== size) canvas.width = canvas.height = size;
    const context = canvas.getContext('2d');
    if (!scene.still || !this.view) this.fit(scene);
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
    for (const [x, y, size, , present] of scene.changes || []) {
      context.strokeStyle = colour(present ? 'fault' : 'line');
      context.lineWidth = 2.5 * ratio;
      context.beginPath();
      context.arc(...at(x, y), Math.max(0.5 * size * scale, 6 * ratio), 0, 2 * Math.PI);
      context.stroke();
    }
    if (scene.robot) this.robot(context, scene, at, scale, ratio);
  }

  // Place on the map of a pixel of the canvas, as of an event there.
  placeAt(left, top) {
    const [cx, cy, half] = this.view;
    const share = (2 * half) / this.canvas.clientWidth;
    return [cx - half + share * left, cy + half - share * top];
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

  // The robot to scale, but never too small to be seen: body, wheels, sensors and their rays. A ray
  // that meets nothing ends, dashed, at the reach of its sensor; one that does ends in a point.
  robot(context, { robot, mounts, ranges, reach, track, wheel }, at, scale, ratio) {
    const faces = mounts || [];
    context.strokeStyle = context.fillStyle = colour('ray');
    context.lineWidth = ratio;
    (ranges || []).forEach((distance, i) => {
      if (distance === null || !faces[i]) return;
      const from = compose(robot, faces[i]);
      const free = reach !== undefined && distance >= reach;
      const end = at(...compose(from, [free ? reach : distance, 0, 0]));
      context.setLineDash(free ? [2 * ratio, 4 * ratio] : []);
      line(context, ...at(from[0], from[1]), ...end);
      if (!free) disc(context, ...end, 2.5 * ratio);
    });
    context.setLineDash([]);
    const half = 0.5 * (track || 0.15);
    const radius = wheel || 0.3 * half;
    const ahead = faces.length ? Math.max(...faces.map(([x]) => x)) : half;
    const size = Math.max(1, (9 * ratio) / (ahead * scale));
    const point = (x, y) => at(...compose(robot, [size * x, size * y, 0]));
    const shape = (corners, name) => {
      context.fillStyle = colour(name);
      context.beginPath();
      corners.forEach((corner, i) => context[i ? 'lineTo' : 'moveTo'](...point(...corner)));
      context.fill();
    };
    const box = (x, y, length, width) => [[x + length, y + width], [x + length, y - width],
      [x - length, y - width], [x - length, y + width]];
    shape(box(0, 0, ahead, 0.85 * half), 'odometry');
    for (const side of [half, -half]) shape(box(0, side, radius, 0.12 * half), 'ink');
    shape([[0.9 * ahead, 0], [0.3 * ahead, 0.4 * half], [0.3 * ahead, -0.4 * half]], 'paper');
    context.fillStyle = colour('ray');
    for (const [x, y] of faces) disc(context, ...point(x, y), 1.8 * ratio);
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
