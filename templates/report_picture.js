"use strict";
// The menu's picture: drawn anew from the numbers in this page whenever a control moves.
// As wide as it is shown, so that its texts have one size on a phone and on a desk.
const widthFor = (shown) => Math.round(Math.min(Math.max(shown, 320), 960) / 20) * 20;
const BOX = {height: 380, left: 70, right: 0, top: 16, bottom: 332};
let width = 0;
const svg = (name, attributes, text) => {
  const node = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
  if (text !== undefined) node.textContent = text;
  return node;
};

function axis(values, start, end) {
  let low = Infinity, high = -Infinity;
  for (const value of values) if (value > 0) { low = Math.min(low, Math.log10(value)); high = Math.max(high, Math.log10(value)); }
  const pad = Math.max(0.06 * (high - low), (0.32 - (high - low)) / 2, 0.03);
  low -= pad;
  high += pad;
  return {low, high, at: (v) => start + (Math.log10(v) - low) / (high - low) * (end - start),
    inside: (v) => Math.log10(v) >= low && Math.log10(v) <= high};
}

function ticks(one, most) {
  for (const steps of [[1, 1.5, 2, 3, 4, 5, 7], [1, 2, 5], [1, 3], [1]]) {
    const found = [];
    for (let d = Math.floor(one.low); d <= Math.ceil(one.high); d++)
      for (const m of steps) if (one.inside(m * 10 ** d)) found.push(m * 10 ** d);
    if (found.length <= most || steps.length === 1) return found.filter((_, i) => i % Math.ceil(found.length / most) === 0);
  }
  return [];
}

function front(column, among) {
  const rows = offers.row.map((_, i) => i).filter((i) => among[i]);
  rows.sort((a, b) => column[a] - column[b] || offers.x[a] - offers.x[b]);
  const found = [];
  let least = Infinity;
  for (const i of rows) if (offers.x[i] < least) { found.push(i); least = offers.x[i]; }
  return found;
}

function draw(answer, latency, cost) {
  const hourly = element("per-hour").checked;
  const column = hourly ? offers.price : offers.cost, faint = hourly ? data.faint.price : data.faint.cost;
  const picture = element("picture");
  width = widthFor(picture.clientWidth);
  BOX.right = width - 14;
  picture.setAttribute("viewBox", `0 0 ${width} ${BOX.height}`);
  const near = (limit, values) => limit > 0 && limit < 10 * Math.max(...values) && limit > 0.1 * Math.min(...values);
  const xs = column.concat(faint), ys = offers.x.concat(data.faint.x);
  if (!hourly && cost !== null && near(cost, xs)) xs.push(cost);
  if (!data.metric && latency !== null && near(latency, ys)) ys.push(latency);
  const x = axis(xs, BOX.left, BOX.right), y = axis(ys, BOX.bottom, BOX.top);
  const nodes = [];
  const clip = (v, low, high) => Math.min(Math.max(v, low), high);
  const [factor, unit] = hourly ? [1, "price of an hour"] : requestsUnit(column);
  for (const value of ticks(y, 9)) {
    nodes.push(svg("line", {class: "grid", x1: BOX.left, x2: BOX.right, y1: y.at(value), y2: y.at(value)}));
    nodes.push(svg("text", {class: "soft", x: BOX.left - 8, y: y.at(value) + 4, "text-anchor": "end"}, data.metric ? digits(value, 3) : duration(value)));
  }
  for (const value of ticks(x, (BOX.right - BOX.left) / 75)) {
    nodes.push(svg("line", {class: "grid", y1: BOX.top, y2: BOX.bottom, x1: x.at(value), x2: x.at(value)}));
    nodes.push(svg("text", {class: "soft", x: x.at(value), y: BOX.bottom + 18, "text-anchor": "middle"}, money(value * factor)));
  }
  if (!data.metric && latency !== null && latency > 0) {
    const at = clip(y.at(latency), BOX.top, BOX.bottom);
    nodes.push(svg("rect", {class: "no", x: BOX.left, y: BOX.top, width: BOX.right - BOX.left, height: at - BOX.top}));
    if (at === y.at(latency)) nodes.push(svg("line", {class: "limit", x1: BOX.left, x2: BOX.right, y1: at, y2: at}));
  }
  if (!hourly && cost !== null && cost > 0) {
    const at = clip(x.at(cost), BOX.left, BOX.right);
    nodes.push(svg("rect", {class: "no", x: at, y: BOX.top, width: BOX.right - at, height: BOX.bottom - BOX.top}));
    if (at === x.at(cost)) nodes.push(svg("line", {class: "limit", y1: BOX.top, y2: BOX.bottom, x1: at, x2: at}));
  }
  if (hourly && cost !== null && cost > 0 && !data.metric && !data.costs.requests_per_s) nodes.push(...slope(x, y, cost, clip));
  const specks = {out: "", in: ""};
  data.faint.x.forEach((value, i) => { specks.out += `M${x.at(faint[i]).toFixed(1)} ${y.at(value).toFixed(1)}h0`; });
  offers.x.forEach((value, i) => { specks[answer.meets[i] ? "in" : "out"] += `M${x.at(column[i]).toFixed(1)} ${y.at(value).toFixed(1)}h0`; });
  for (const kind of ["out", "in"]) nodes.push(svg("path", {class: "speck " + kind, d: specks[kind] || "M0 0"}));
  const steps = front(column, answer.balanced === null ? answer.meets.map(() => true) : answer.meets);
  if (steps.length) {
    const path = steps.map((i, n) => n ? `H${x.at(column[i])}V${y.at(offers.x[i])}` : `M${x.at(column[i])} ${BOX.top}V${y.at(offers.x[i])}`);
    nodes.push(svg("path", {class: "stairs", d: path.join("") + "H" + BOX.right}));
  }
  const bar = (i) => {
    if (offers.low[i] === null) return;
    const [low, high] = [offers.low[i], offers.high[i]].map((v) => clip(y.at(v), BOX.top, BOX.bottom).toFixed(1));
    nodes.push(svg("path", {class: "bar", d: `M${(x.at(column[i]) - 3).toFixed(1)} ${low}h6m-3 0V${high}m-3 0h6`}));
  };
  const measured = offers.row.map((_, i) => i).filter((i) => offers.measured[i] && i !== answer.balanced);
  measured.forEach((i) => { nodes.push(dot(i, column, x, y, "measured", 4.2)); bar(i); });
  if (answer.balanced !== null) {
    nodes.push(dot(answer.balanced, column, x, y, "chosen", 6.5));
    bar(answer.balanced);
    nodes.push(...labels(answer, column, x, y));
  }
  nodes.push(svg("text", {class: "soft", x: (BOX.left + BOX.right) / 2, y: BOX.bottom + 38, "text-anchor": "middle"},
    unit + " (log scale)"));
  picture.replaceChildren(...nodes);
  picture.setAttribute("aria-label", `${data.metric || data.statistic + " latency"} against ${hourly ? "price of an hour" : "cost of a request"}. ` + element("verdict").textContent);
}

// The limit on the cost of a request against the price of an hour: latency at most cost / price.
function slope(x, y, cost, clip) {
  const edge = [];
  for (let n = 0; n <= 100; n++) {
    const price = 10 ** (x.low + (n / 100) * (x.high - x.low));
    edge.push(`${x.at(price).toFixed(1)} ${clip(y.at(cost * 3600 / price), BOX.top, BOX.bottom).toFixed(1)}`);
  }
  const line = "M" + edge.join("L");
  return [svg("path", {class: "no", d: `${line}L${BOX.right} ${BOX.top}L${BOX.left} ${BOX.top}Z`}), svg("path", {class: "limit", d: line})];
}

function dot(i, column, x, y, kind, radius) {
  const node = svg("circle", {class: "dot " + kind, cx: x.at(column[i]), cy: y.at(offers.x[i]), r: radius});
  node.append(svg("title", {}, `${described(i)}: ${amount(offers.x[i])}, ${money(offers.cost[i])} per request, ${money(offers.price[i])} per hour`));
  return node;
}


// The choice, and what is cheapest and fastest, beside their dots: left out where there is no room for them.
function labels(answer, column, x, y) {
  const taken = [], found = [];
  const named = new Map([[answer.fastest, "fastest"], [answer.cheapest, "cheapest"], [answer.balanced, "chosen"]]);
  for (const [i, role] of [...named].reverse()) {
    const words = `${role}: ${offers.name[i]}`, px = x.at(column[i]), py = y.at(offers.x[i]), long = 7.6 * words.length;
    const spots = [[px + 10, py - 9], [px - 10 - long, py - 9], [px + 10, py + 19], [px - 10 - long, py + 19],
      [px - long / 2, py - 22], [px - long / 2, py + 32]].map(([left, base]) => [left, base - 12, left + long, base + 4]);
    const free = (box) => box[0] > BOX.left && box[2] < width && box[1] > 0 && box[3] < BOX.bottom &&
      !taken.some((other) => box[0] < other[2] && other[0] < box[2] && box[1] < other[3] && other[1] < box[3]);
    const box = spots.find(free) || (role === "chosen" ? spots[px > width / 2 ? 1 : 0] : null);
    if (!box) continue;
    taken.push(box);
    found.push(svg("text", {class: "label label-" + (role === "chosen" ? "chosen" : "named"), x: box[0], y: box[3] - 4}, words));
  }
  return found;
}

// How many requests' cost is shown, so that the figures are short: factor and words.
function requestsUnit(costs) {
  const middle = costs.slice().sort((a, b) => a - b)[Math.floor(costs.length / 2)];
  if (middle >= 0.01) return [1, "cost of one request"];
  return middle >= 0.00001 ? [1000, "cost of 1,000 requests"] : [1e6, "cost of a million requests"];
}
