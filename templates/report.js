"use strict";
// The rule of `fogspec menu`, over the numbers in this page.
const data = JSON.parse(document.getElementById("data").textContent);
const offers = data.offers, count = offers.row.length;

// What a limit on the cost of a request leaves an offer, in seconds.
function withinCost(i, limit) {
  const left = limit - data.costs.transfer, rate = data.costs.interruptions_per_s;
  if (data.costs.requests_per_s) return offers.usd_per_s[i] / data.costs.requests_per_s <= left ? Infinity : 0;
  const seconds = Math.max(left, 0) / offers.usd_per_s[i];
  return offers.spot[i] && rate > 0 ? Math.log1p(rate * seconds) / rate : seconds;
}

// Every limit that is set: its name, its bound, and the values that it bounds.
function boundsOf(latency, cost) {
  const found = [];
  if (latency !== null) found.push({name: "latency", bound: latency, value: offers.latency});
  if (cost !== null) found.push({name: "cost", bound: cost, value: offers.cost});
  if (data.costs.requests_per_s) found.push({name: "rate", bound: 1 / data.costs.requests_per_s, value: offers.latency});
  return found.concat(data.fixed);
}

const held = (one, i) => one.value[i] !== null && one.value[i] <= one.bound;

// The offers that meet all limits with the asked probability, else those more likely to meet them than not.
function feasibleUnder(bounds, latency, cost) {
  const all = offers.row.map((_, i) => bounds.every((one) => held(one, i)));
  if (!data.probabilities) return {meets: all, floor: null};
  if (!bounds.length) return {meets: all, floor: data.confidence};
  const price = data.fixed.find((one) => one.name === "price");
  const within = offers.row.map((_, i) => {
    if (price && !held(price, i)) return 0;
    let most = latency === null ? Infinity : latency;
    if (data.costs.requests_per_s) most = Math.min(most, 1 / data.costs.requests_per_s);
    return cost === null ? most : Math.min(most, withinCost(i, cost));
  });
  for (let f = 0; f < data.floors.length; f++) {
    const meets = all.map((one, i) => one && data.offers.needed[f][i] <= within[i]);
    if (meets.includes(true)) return {meets, floor: data.floors[f]};
  }
  return {meets: all.map(() => false), floor: null};
}

// The best of some offers by a column; ties go by cost, latency, name and the catalog's order.
function firstBy(column, among) {
  let least = Infinity;
  for (let i = 0; i < count; i++) if (among[i]) least = Math.min(least, column[i]);
  if (least === Infinity) return null;
  let best = null;
  for (let i = 0; i < count; i++) {
    if (!among[i] || column[i] > least + data.tie * Math.abs(least)) continue;
    if (best === null || before(i, best)) best = i;
  }
  return best;
}

function before(i, j) {
  for (const key of ["cost", "latency", "name", "row"])
    if (offers[key][i] !== offers[key][j]) return offers[key][i] < offers[key][j];
  return false;
}

// What a request costs that takes so long.
function costOf(i, seconds) {
  const rate = data.costs.interruptions_per_s;
  if (data.costs.requests_per_s) return offers.usd_per_s[i] / data.costs.requests_per_s + data.costs.transfer;
  const paid = offers.spot[i] && rate > 0 ? Math.expm1(rate * seconds) / rate : seconds;
  return offers.usd_per_s[i] * paid + data.costs.transfer;
}

// What each limit would have to be for an offer to meet it with the least probability that is enough.
function needOf(one, i) {
  if (one.name === "latency" || one.name === "rate") return offers.needs[i];
  return one.name === "cost" ? costOf(i, offers.needs[i]) : one.needs[i];
}

// How far each limit would have to move where nothing meets them all.
function misses(bounds) {
  const factor = bounds.map((one) => offers.row.map((_, i) => (one.bound > 0 ? needOf(one, i) / one.bound : Infinity)));
  const met = (b, i) => needOf(bounds[b], i) <= bounds[b].bound;
  const least = (score, among) => among.reduce((best, i) => (best === null || score(i) < score(best) ? i : best), null);
  const all = offers.row.map((_, i) => i), named = bounds.map((_, b) => b);
  const missed = (b, i) => ({name: bounds[b].name, factor: factor[b][i], name_of: offers.name[i]});
  let found = named.flatMap((b) => {
    const others = all.filter((i) => named.every((other) => other === b || met(other, i)));
    const best = least((i) => needOf(bounds[b], i), others.length ? others : all);
    return best !== null && factor[b][best] > 1 ? [missed(b, best)] : [];
  });
  if (!found.length && bounds.length) {
    const nearest = least((i) => Math.max(...named.map((b) => factor[b][i])), all);
    if (nearest !== null) found = named.filter((b) => !met(b, nearest)).map((b) => missed(b, nearest));
  }
  return found.sort((a, b) => b.factor - a.factor);
}

// The objective's terms and the pool of the choice under these limits; the weight comes later.
function under(latencyLimit, cost) {
  const latency = latencyLimit === null ? null : latencyLimit - data.network;
  const bounds = boundsOf(latency, cost);
  const {meets, floor} = feasibleUnder(bounds, latency, cost);
  const scaleX = data.scale.x || (data.metric ? null : latency) || data.scale.best_x;
  const scaleCost = data.scale.cost || cost || data.scale.best_cost;
  const measured = meets.map((one, i) => one && offers.measured[i] === 1);
  const pool = data.adaptive && measured.includes(true) ? measured : meets;
  return {latency, cost, bounds, meets, floor, pool, scaleX, scaleCost};
}

const objectiveOf = (alpha, limits) =>
  offers.x.map((x, i) => alpha * x / limits.scaleX + (1 - alpha) * offers.cost[i] / limits.scaleCost);

function decide(alpha, latencyLimit, cost) {
  const limits = under(latencyLimit, cost), objective = objectiveOf(alpha, limits), pool = limits.pool;
  const found = {balanced: firstBy(objective, pool), cheapest: firstBy(offers.cost, pool), fastest: firstBy(offers.latency, pool)};
  return {...limits, ...found, alpha, objective, misses: found.balanced === null ? misses(limits.bounds) : []};
}

// ---- words ------------------------------------------------------------------------------------------------------

const times = (factor) => (Number.isFinite(factor) ? `${trim(factor.toPrecision(3))} times the limit` : "more than nothing");
const trim = (text) => (text.includes(".") ? text.replace(/\.?0+$/, "") : text);
const written = (value) => (value < 1000 ? Number(value.toPrecision(4)) : value); // as files have it: what is shown is rounded from that
const digits = (value, n) => {
  if (!(value > 0)) return "0";
  if (n <= 3) value = written(value);
  return trim(value.toFixed(Math.max(0, Math.min(20, n - 1 - Math.floor(Math.log10(value))))));
};
const money = (usd) => {
  if (!(usd > 0)) return "$0";
  usd = written(usd);
  const places = Math.max(usd >= 99.95 ? 0 : 2, 2 - Math.floor(Math.log10(usd)));
  return "$" + usd.toFixed(Math.min(places, 20)).replace(/(\.\d\d\d*?)0+$/, "$1");
};
const duration = (s) => (s < 0.001 ? digits(s * 1e6, 3) + " µs" : s < 1 ? digits(s * 1000, 3) + " ms" : digits(s, 3) + " s");
const amount = (value) => (data.metric ? digits(value, 3) + (data.unit ? " " + data.unit : "") : duration(value));
const plain = (value) => (/e/.test(String(value)) ? digits(value, 12) : String(value));
const [FACTOR, PER] = data.per;
const cost = (usd) => money(usd * FACTOR);
const known = (i) => (offers.measured[i] ? "measured" : "predicted, not measured");
const named = (i) => offers.name[i] + (offers.spot[i] ? " spot" : "");

function described(i) {
  const gpu = offers.gpu[i] ? ", " + offers.gpu[i] : "";
  return `${named(i)} (${offers.vcpus[i]} vCPU, ${digits(offers.memory[i], 4)} GiB${gpu})`;
}

function interval(i) {
  return offers.low[i] === null ? "" : ` [${amount(offers.low[i])}, ${amount(offers.high[i])}]`;
}

// Why a machine cannot be chosen under these limits; empty of one that can.
function whyNot(i, answer) {
  const missed = answer.bounds.filter((one) => !held(one, i)).map((one) => one.name.replace("metrics.", ""));
  if (missed.length) return `misses ${missed.join(", ")}`;
  if (!answer.meets[i]) return `P below ${answer.floor ?? data.confidence}`;
  return answer.pool[i] ? "" : "not measured";
}

// ---- controls ---------------------------------------------------------------------------------------------------

const element = (id) => document.getElementById(id);
const make = (name, text, attributes = {}) => {
  const node = document.createElement(name);
  if (text !== undefined) node.textContent = text;
  for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
  return node;
};
const STEPS = 1000, scaled = (value, factor) => (factor === 1 ? value : Number((value * factor).toPrecision(12)));

// `factor` is how many times the unit of the data the control shows.
function limitControl(name, column, factor = 1) {
  const use = element(name + "-use"), range = element(name + "-range"), number = element(name + "-number");
  const set = data.limits[name], values = column.concat(set ? [set] : []).filter((v) => v > 0);
  const low = Math.log(Math.min(...values) / 1.5), high = Math.log(Math.max(...values) * 1.5);
  const place = (value) => Math.round((Math.log(value) - low) / (high - low) * STEPS);
  const start = set === null ? Math.exp((low + high) / 2) : set;
  const to = (value, text) => {
    use.checked = value !== null;
    number.value = text ?? (value === null ? digits(start * factor, 3) : plain(scaled(value, factor)));
    range.value = place(value ?? start);
  };
  range.max = STEPS;
  to(set);
  range.addEventListener("input", () => {
    number.value = digits(factor * Math.exp(low + (range.value / STEPS) * (high - low)), 3);
    use.checked = true;
    update();
  });
  number.addEventListener("input", () => {
    if (Number(number.value) > 0) { range.value = place(Number(number.value) / factor); use.checked = true; }
    update();
  });
  use.addEventListener("change", () => update());
  return {
    to, reset: () => to(set),
    value: () => (use.checked && Number(number.value) > 0 ? scaled(Number(number.value), 1 / factor) : null),
    say: (words) => range.setAttribute("aria-valuetext", words),
  };
}

const limitControls = {latency: limitControl("latency", offers.latency), cost: limitControl("cost", offers.cost, FACTOR)};
const alphaRange = element("alpha");
alphaRange.step = Number.isInteger(data.alpha * 100) ? "0.01" : "any";
alphaRange.value = data.alpha;
const bySpec = count ? decide(data.alpha, data.limits.latency, data.limits.cost) : null;
const state = {sort: "objective", down: false, pinned: [], answer: null};

function update(save = true) {
  const alpha = Number(alphaRange.value), latency = limitControls.latency.value(), usd = limitControls.cost.value();
  const answer = state.answer = decide(alpha, latency, usd);
  const words = `${alpha.toFixed(2)} ${data.metric || "latency"} + ${(1 - alpha).toFixed(2)} cost`;
  element("alpha-words").textContent = words;
  alphaRange.setAttribute("aria-valuetext", words);
  limitControls.latency.say(latency === null ? "no limit" : "at most " + duration(latency));
  limitControls.cost.say(usd === null ? "no limit" : `at most ${cost(usd)} per ${PER}`);
  showVerdict(answer);
  showStrip(answer);
  showCandidates(answer);
  showCompared();
  draw(answer);
  const limit = (value, written) => (value === null ? "none" : written);
  element("command").textContent = `${data.command} --alpha ${plain(alpha)} --latency ${limit(latency, plain(latency) + "s")} ` +
    `--cost ${limit(usd, `'$${plain(usd)}/request'`)}`;
  if (save) history.replaceState(null, "", `#a=${plain(alpha)}&l=${limit(latency, plain(latency))}&c=${limit(usd, plain(usd))}&v=${view()}`);
}

function showVerdict(answer) {
  const verdict = element("verdict"), chosen = answer.balanced;
  verdict.dataset.chosen = chosen === null ? "" : offers.name[chosen];
  verdict.dataset.infra = chosen === null ? "" : offers.infra[chosen];
  if (chosen === null) {
    const words = answer.misses.map((one) => `${one.name}: the best machine needs ${times(one.factor)} (${one.name_of})`);
    if (!count) verdict.textContent = "No machine can be predicted: no sample is valid, or every admissible machine failed.";
    else verdict.textContent = words.length ? "No machine meets the limits: " + words.join("; ") + "." : "No machine is likely enough to meet the limits.";
    return;
  }
  const number = answer.meets.filter(Boolean).length, same = chosen === bySpec.balanced;
  const total = data.complete ? ` ${number} of ${count} instance types meet${number === 1 ? "s" : ""} the limits.` : "";
  const unsure = answer.floor !== null && answer.floor < data.confidence
    ? ` No machine meets the limits with probability ${data.confidence}: this is the best of those more likely to meet them than not.` : "";
  verdict.textContent = `${same ? "Same choice" : "Changes to"}${same ? ": " : " "}${described(chosen)} in ${offers.infra[chosen]} (${known(chosen)}): ` +
    `${amount(offers.x[chosen])}, ${cost(offers.cost[chosen])} per ${PER}, ${money(offers.price[chosen])}/h.${total}${unsure}`;
}

// Which machine wins for which weight: the rule at 101 weights.
function showStrip(answer) {
  const strip = element("strip"), runs = [];
  for (let step = 0; step <= 100; step++) {
    const winner = firstBy(objectiveOf(step / 100, answer), answer.pool), last = runs[runs.length - 1];
    if (last && last.winner === winner) last.to = step / 100;
    else runs.push({winner, from: step / 100, to: step / 100});
  }
  strip.replaceChildren(...(answer.balanced === null ? [make("span", "none")] : runs.map((run) => {
    const now = run.winner === answer.balanced, range = `${Math.round(100 * run.from)}% to ${Math.round(100 * run.to)}% ${data.metric || "latency"}`;
    const node = make("button", named(run.winner), {type: "button", title: `${named(run.winner)}: ${range}`, "aria-label": `${named(run.winner)}, ${range}`});
    node.style.flexGrow = Math.max(run.to - run.from, 0.01) * 100;
    node.classList.toggle("now", now);
    node.addEventListener("click", () => { alphaRange.value = (run.from + run.to) / 2; update(); });
    return node;
  })));
}

// ---- candidates -------------------------------------------------------------------------------------------------

const COLUMNS = [
  ["machine", (i) => named(i), (i) => named(i)],
  ["infra", (i) => offers.infra[i], (i) => offers.infra[i]],
  ["vCPU", (i) => offers.vcpus[i], (i) => String(offers.vcpus[i]), true],
  ["GiB", (i) => offers.memory[i], (i) => digits(offers.memory[i], 4), true],
  ["GPU", (i) => offers.gpu[i], (i) => offers.gpu[i]],
  ["per hour", (i) => offers.price[i], (i) => money(offers.price[i]), true],
  [data.metric || "latency", (i) => offers.x[i], (i) => amount(offers.x[i]) + interval(i), true],
  [`per ${PER}`, (i) => offers.cost[i], (i) => cost(offers.cost[i]), true],
  ["P, spec's limits", (i) => -(offers.probability[i] ?? -1), (i) => (offers.probability[i] === null ? "" : String(offers.probability[i])), true],
  ["objective", (i) => state.answer.objective[i], (i) => digits(state.answer.objective[i], 3), true],
  ["known", (i) => -offers.measured[i], (i) => (offers.measured[i] ? "measured" : "predicted")],
  ["why not", (i) => whyNot(i, state.answer), (i) => whyNot(i, state.answer)],
].filter(([head]) => (head !== "GPU" || offers.gpu.some(Boolean)) && (head !== "infra" || new Set(offers.infra).size > 1) &&
  (head !== "P, spec's limits" || offers.probability.some((one) => one !== null)));
const MOST_ROWS = 300, FOLDED = 5;  // on a phone, the others after a button
const more = element("more");
let unfolded = false;
more.addEventListener("click", () => {
  unfolded = !unfolded;
  element("candidates").classList.toggle("unfolded", unfolded);
  showCandidates(state.answer);
});

COLUMNS.forEach(([head, , , number]) => {
  const cell = make("th", undefined, {scope: "col", ...(number ? {class: "number"} : {})}), button = make("button", head, {type: "button"});
  button.addEventListener("click", () => {
    state.down = state.sort === head && !state.down;
    state.sort = head;
    showCandidates(state.answer);
  });
  cell.append(button);
  document.querySelector("#candidates thead tr").append(cell);
});

function showCandidates(answer) {
  const roles = new Map();
  if (answer.balanced !== null) for (const [role, i] of [["chosen", answer.balanced], ["cheapest", answer.cheapest], ["fastest", answer.fastest]])
    roles.set(i, [...(roles.get(i) || []), role]);
  const words = element("filter").value.trim().toLowerCase(), key = (COLUMNS.find(([head]) => head === state.sort) || COLUMNS[0])[1];
  const wanted = (i) => (!element("only-meets").checked || answer.meets[i]) && (!element("only-measured").checked || offers.measured[i]) &&
    `${named(i)} ${offers.infra[i]} ${offers.gpu[i]}`.toLowerCase().includes(words);
  const rank = new Map(offers.row.map((_, i) => [i, key(i)]));
  const order = (i, j) => (rank.get(i) < rank.get(j) ? -1 : rank.get(i) > rank.get(j) ? 1 : 0) * (state.down ? -1 : 1);
  const first = (i) => (state.sort === "objective" && !state.down ? !answer.pool[i] : 0);
  const found = offers.row.map((_, i) => i).filter(wanted).sort((i, j) => first(i) - first(j) || order(i, j));
  const shown = found.filter((i, at) => at < MOST_ROWS || roles.has(i));
  element("counted").textContent = `${found.length} of ${count}` + (shown.length < found.length ? `, the first ${MOST_ROWS} shown` : "");
  document.querySelectorAll("#candidates thead th").forEach((cell, at) => {
    if (COLUMNS[at][0] === state.sort) cell.setAttribute("aria-sort", state.down ? "descending" : "ascending");
    else cell.removeAttribute("aria-sort");
  });
  const rest = shown.length - shown.filter((i, at) => at < FOLDED || roles.has(i)).length;
  more.textContent = unfolded ? `Show the first ${FOLDED}` : `Show all ${shown.length} machines`;
  more.hidden = rest === 0;
  element("candidates").tBodies[0].replaceChildren(...shown.map((i) => candidate(i, roles.get(i) || [])));
}

function candidate(i, roles) {
  const row = make("tr", undefined, {"data-at": i, tabindex: "-1"});
  if (roles.length) { row.dataset.roles = roles.join(" "); row.dataset.row = offers.row[i]; }
  row.classList.toggle("chosen", roles.includes("chosen"));
  row.classList.toggle("pinned", state.pinned.includes(i));
  COLUMNS.forEach(([head, , text, number], at) => {
    const words = text(i) + (at === 0 && roles.length ? ` · ${roles.join(", ")}` : "");
    row.append(at === 0 ? make("th", words, {scope: "row"}) : make("td", words, {"data-head": head, ...(number ? {class: "number"} : {})}));
  });
  return row;
}

for (const id of ["filter", "only-meets", "only-measured"]) element(id).addEventListener("input", () => showCandidates(state.answer));
element("candidates").addEventListener("click", (event) => { const row = event.target.closest("tbody tr"); if (row) pin(Number(row.dataset.at)); });
element("candidates").addEventListener("mouseover", (event) => { const row = event.target.closest("tbody tr"); light(row ? Number(row.dataset.at) : null); });
element("candidates").addEventListener("mouseleave", () => light(null));

function pin(i) {
  state.pinned = state.pinned.includes(i) ? state.pinned.filter((one) => one !== i) : [...state.pinned, i].slice(-2);
  for (const row of element("candidates").tBodies[0].rows) row.classList.toggle("pinned", state.pinned.includes(Number(row.dataset.at)));
  for (const [at, nodes] of marks) for (const node of nodes) node.classList.toggle("pinned", state.pinned.includes(at));
  showCompared();
}

function showCompared() {
  const [one, other] = state.pinned.length === 2 ? state.pinned : [state.answer.balanced, state.pinned[0]];
  const box = element("compare");
  if (one === null || one === undefined || other === undefined || one === other) return box.replaceChildren();
  const signed = (difference, words) => (difference < 0 ? "−" : "+") + words(Math.abs(difference));
  box.replaceChildren(make("strong", `${named(other)} against ${named(one)}: `), make("span",
    `${signed(offers.x[other] - offers.x[one], amount)}, ${signed(offers.cost[other] - offers.cost[one], cost)} per ${PER}, ` +
    `${signed(offers.price[other] - offers.price[one], money)}/h, objective ${signed(state.answer.objective[other] - state.answer.objective[one], (v) => digits(v, 3))}. ` +
    `${named(other)} is ${known(other)}, ${named(one)} ${known(one)}.`));
}

// ---- the chart: drawn by fogspec, here only marked --------------------------------------------------------------

const place = new Map(offers.row.map((row, i) => [row, i])), marks = new Map();
const stage = element("stage"), card = element("card");
const charts = [...stage.querySelectorAll("svg")].map((svg) => {
  const [xLow, xHigh, left, right] = svg.dataset.x.split(" ").map(Number), [yLow, yHigh, bottom, top] = svg.dataset.y.split(" ").map(Number);
  const inSvg = (name, kind, before) => { const node = document.createElementNS(svg.namespaceURI, name); node.setAttribute("class", kind); before.before(node); return node; };
  const first = svg.querySelector("text"), mark = svg.querySelector(".bar, .mark") || svg.lastElementChild;
  const bars = [...svg.querySelectorAll(".bar")].map((node) => node.getAttribute("d").match(/-?[\d.]+/g).map(Number));
  const one = {
    svg, bars, xLow, xHigh, yLow, yHigh, left, right, top, bottom, hourly: svg.dataset.view === "chart-hour",
    planes: JSON.parse(svg.dataset.bounds).filter(([name]) => data.metric === name || (name !== "latency" && name !== "cost")),
    x: (log) => left + (log - xLow) / (xHigh - xLow) * (right - left), y: (log) => bottom + (log - yLow) / (yHigh - yLow) * (top - bottom),
    feasible: svg.querySelector(".feasible") || inSvg("path", "feasible", first), iso: svg.querySelector(".iso") || inSvg("path", "iso", mark), limits: {},
  };
  for (const name of data.metric ? ["cost"] : ["latency", "cost"]) {
    svg.querySelector(`.limit[data-limit="${name}"]`)?.remove();
    one.limits[name] = {line: inSvg("path", "limit", mark), drag: inSvg("path", "drag", mark), words: inSvg("text", "label label-of-limit", mark)};
    svg.append(one.limits[name].words);
    one.limits[name].drag.dataset.limit = name;
  }
  for (const node of svg.querySelectorAll(".mark")) {
    const i = place.get(Number(node.dataset.row)), title = node.querySelector("title");
    if (i === undefined) continue;
    if (title) title.remove();
    node.setAttribute("role", "button");
    node.setAttribute("tabindex", "-1");
    marks.set(i, [...(marks.get(i) || []), node]);
  }
  return one;
});

const view = () => (element("per-hour").checked ? "hour" : element("all").checked ? "all" : "near");

function clip(polygon, a, b, most) {
  return polygon.flatMap(([p, q], at) => {
    const [r, s] = polygon[(at + 1) % polygon.length], here = a * p + b * q - most, there = a * r + b * s - most;
    const cut = here > 0 !== there > 0 ? [[p + here / (here - there) * (r - p), q + here / (here - there) * (s - q)]] : [];
    return here <= 0 ? [[p, q], ...cut] : cut;
  });
}

function draw(answer) {
  for (const one of charts) {
    one.svg.toggleAttribute("hidden", one.svg.dataset.view !== "chart-" + view());
    const live = [], frame = [[one.xLow, one.yLow], [one.xHigh, one.yLow], [one.xHigh, one.yHigh], [one.xLow, one.yHigh]];
    if (!data.metric && answer.latency > 0) live.push(["latency", 0, 1, Math.log10(answer.latency), `latency limit ${duration(answer.latency)}`]);
    if (answer.cost > 0 && (!one.hourly || data.costs.requests_per_s)) live.push(["cost", 1, 0, Math.log10(answer.cost * (one.hourly ? data.per_hour : 1)), `cost limit ${cost(answer.cost)}`]);
    else if (answer.cost > 0 && !data.metric) live.push(["cost", 1, 1, Math.log10(answer.cost * 3600), `cost limit ${cost(answer.cost)}`]);
    let inside = frame;
    for (const [, a, b, most] of [...one.planes, ...live]) inside = clip(inside, a, b, most);
    const path = (points) => points.map(([p, q], n) => `${n ? "L" : "M"}${one.x(p).toFixed(1)} ${one.y(q).toFixed(1)}`).join("");
    one.feasible.setAttribute("d", one.planes.length + live.length && inside.length > 2 ? path(inside) + "Z" : "");
    for (const [name, nodes] of Object.entries(one.limits)) {
      const found = live.find(([other]) => other === name), edge = found ? clip(frame, ...found.slice(1, 4)).filter(([p, q]) => Math.abs(found[1] * p + found[2] * q - found[3]) < 1e-9) : [];
      const d = edge.length > 1 ? path([edge[0], edge[edge.length - 1]]) : "";
      nodes.line.setAttribute("d", d);
      nodes.drag.setAttribute("d", d);
      nodes.words.textContent = d ? found[4] : "";
      nodes.edge = d ? edge : null;
    }
    one.labels = [];
    for (const [name, nodes] of Object.entries(one.limits)) if (nodes.edge) placeWords(one, name, nodes);
    one.iso.setAttribute("d", one.hourly || answer.balanced === null ? "" : isoPath(one, answer));
  }
  for (const [i, nodes] of marks) for (const node of nodes) {
    const bar = node.ownerSVGElement.querySelector(`[data-bar="${node.dataset.row}"]`);
    for (const each of bar ? [node, bar] : [node]) {
      each.classList.toggle("meets", answer.meets[i]);
      each.classList.toggle("misses", !answer.meets[i]);
      each.classList.toggle("chosen", i === answer.balanced);
    }
    node.setAttribute("tabindex", i === (answer.balanced ?? place.get(Number(node.ownerSVGElement.querySelector(".mark")?.dataset.row))) ? "0" : "-1");
    node.setAttribute("aria-label", `${named(i)}: ${amount(offers.x[i])}, ${cost(offers.cost[i])} per ${PER}, ${known(i)}${answer.meets[i] ? "" : ", " + whyNot(i, answer)}`);
  }
}

// How many of these segments go through a box (Liang and Barsky, ACM TOG 3 (1984) 1).
const crossed = (bars, [left, top, right, bottom]) => bars.filter(([x1, y1, x2, y2]) => {
  let low = 0, high = 1;
  for (const [step, room] of [[x1 - x2, x1 - left], [x2 - x1, right - x1], [y1 - y2, y1 - top], [y2 - y1, bottom - y1]]) {
    if (step === 0 && room < 0) return false;
    if (step < 0) low = Math.max(low, room / step);
    if (step > 0) high = Math.min(high, room / step);
  }
  return low <= high;
}).length;

// The label of a limit: the full one, or a shorter one that crosses fewer lines.
function placeWords(one, name, {words, edge}) {
  const full = words.textContent, texts = [full, full.replace(`${name} `, "")];
  const found = texts.map((text) => { words.textContent = text; return placeFor(one, name, words, edge); });
  const at = found[1] && (!found[0] || found[1].crossed < found[0].crossed) ? 1 : 0;
  words.textContent = found[at] ? texts[at] : "";
  if (!found[at]) return;
  one.labels.push(found[at]);
  for (const key of ["x", "y"]) words.setAttribute(key, found[at][key].toFixed(1));
}

// The place beside a limit's line where its label touches no mark and no label, crosses the fewest lines and is nearest the far end.
function placeFor(one, name, words, edge) {
  const upright = name === "cost", at = ([p, q]) => [one.x(p), one.y(q)];
  const lines = Object.keys(one.limits).filter((other) => one.limits[other].edge)
    .map((other) => [...at(one.limits[other].edge[0]), ...at(one.limits[other].edge.at(-1))]);
  const column = one.hourly ? offers.price : offers.cost, long = words.getComputedTextLength() || 7.6 * words.textContent.length; // 0 where it is hidden
  const dots = [...marks.keys()].map((i) => [one.x(Math.log10(column[i])), one.y(Math.log10(offers.x[i]))]);
  const [near, far] = [edge[0], edge.at(-1)].map(at).sort((a, b) => (upright ? b[1] - a[1] : a[0] - b[0]));
  let best = null;
  for (let step = 0; step <= 40; step++) {
    const x = far[0] + step / 40 * (near[0] - far[0]), y = far[1] + step / 40 * (near[1] - far[1]);
    const spots = [0, 5, 11, 20, 30].flatMap((by) => (upright ? [[x + 6 + by, y + 15, by], [x - 6 - by - long, y + 15, by]] : [[x - long - 4, y - 6 - by, by], [x - long - 4, y + 16 + by, by]]));
    const free = ([left, base]) => left > one.left && left + long < one.right + 4 && base - 11 > one.top && base < one.bottom &&
      !dots.some(([dx, dy]) => dx > left - 8 && dx < left + long + 8 && dy > base - 18 && dy < base + 9) &&
      !one.labels.some((other) => left < other.x + other.long + 8 && other.x < left + long + 8 && Math.abs(base - other.y) < 18);
    for (const [left, base, by] of spots.filter(free)) {
      const through = crossed([...one.bars, ...lines], [left - 2, base - 13, left + long + 3, base + 4]), bad = 50 * through + step + by;
      if (best === null || bad < best.bad) best = {bad, crossed: through, x: left, y: base, long};
    }
  }
  return best;
}

// Machines as good as the choice: alpha x / scale + (1 - alpha) cost / scale = its objective.
function isoPath(one, answer) {
  const value = answer.objective[answer.balanced], points = [];
  for (let n = 0; n <= 60; n++) {
    const log = one.xLow + (n / 60) * (one.xHigh - one.xLow), x = (value - (1 - answer.alpha) * 10 ** log / answer.scaleCost) * answer.scaleX / answer.alpha;
    const y = Math.log10(x);
    if (x > 0 && y >= one.yLow && y <= one.yHigh) points.push(`${one.x(log).toFixed(1)} ${one.y(y).toFixed(1)}`);
  }
  return points.length > 1 ? "M" + points.join("L") : "";
}

function light(i, node) {
  for (const [at, nodes] of marks) for (const one of nodes) one.classList.toggle("lit", at === i);
  for (const row of element("candidates").tBodies[0].rows) row.classList.toggle("lit", Number(row.dataset.at) === i);
  card.hidden = !node;
  if (!node) return;
  const why = whyNot(i, state.answer);
  card.replaceChildren(make("p", described(i)), make("p", `${amount(offers.x[i])}${interval(i)}, ${known(i)}`),
    make("p", `${cost(offers.cost[i])} per ${PER}, ${money(offers.price[i])}/h, ${money(offers.month[i])}/month`),
    make("p", `objective ${digits(state.answer.objective[i], 3)}${why ? "; " + why : ""}`));
  const box = node.getBoundingClientRect(), frame = stage.getBoundingClientRect();
  const below = box.top - frame.top < frame.height / 2, left = Math.min(Math.max(box.left - frame.left + 12, 0), frame.width - card.offsetWidth);
  card.style.left = `${left}px`;
  card.style.top = `${below ? box.bottom - frame.top + 10 : box.top - frame.top - card.offsetHeight - 10}px`;
}

const markAt = (event) => { const node = event.target.closest?.(".mark"), i = node ? place.get(Number(node.dataset.row)) : undefined; return i === undefined ? null : [i, node]; };
stage.addEventListener("mouseover", (event) => { const found = markAt(event); light(found ? found[0] : null, found?.[1]); });
stage.addEventListener("mouseleave", () => light(null));
stage.addEventListener("focusin", (event) => { const found = markAt(event); if (found) light(...found); });
stage.addEventListener("focusout", () => light(null));
stage.addEventListener("click", (event) => { const found = markAt(event); if (found) { light(...found); pin(found[0]); } });
stage.addEventListener("keydown", (event) => {
  const found = markAt(event), step = {ArrowRight: 1, ArrowDown: 1, ArrowLeft: -1, ArrowUp: -1}[event.key];
  if (!found) return;
  if (event.key === "Enter" || event.key === " ") { pin(found[0]); event.preventDefault(); }
  if (event.key === "Escape") light(null);
  if (!step) return;
  event.preventDefault();
  const own = [...found[1].ownerSVGElement.querySelectorAll(".mark")].filter((node) => place.has(Number(node.dataset.row)));
  own.sort((a, b) => offers.x[place.get(Number(a.dataset.row))] - offers.x[place.get(Number(b.dataset.row))]);
  own[(own.indexOf(found[1]) + step + own.length) % own.length].focus();
});
stage.addEventListener("pointerdown", (event) => {
  const name = event.target.dataset?.limit, one = charts.find((each) => each.svg === event.target.ownerSVGElement);
  if (!name || !one) return;
  event.preventDefault();
  const move = (moved) => {
    const box = one.svg.getBoundingClientRect(), scale = one.svg.viewBox.baseVal.width / box.width;
    const x = 10 ** (one.xLow + ((moved.clientX - box.left) * scale - one.left) / (one.right - one.left) * (one.xHigh - one.xLow));
    const y = 10 ** (one.yLow + ((moved.clientY - box.top) * scale - one.bottom) / (one.top - one.bottom) * (one.yHigh - one.yLow));
    const value = name === "latency" ? y + data.network : !one.hourly ? x : data.costs.requests_per_s ? x / data.per_hour : x * y / 3600;
    limitControls[name].to(Number(digits(value, 3)));
    update();
  };
  const end = () => { removeEventListener("pointermove", move); removeEventListener("pointerup", end); };
  addEventListener("pointermove", move);
  addEventListener("pointerup", end);
});

// ---- state ------------------------------------------------------------------------------------------------------

function restore() {
  if (!location.hash.includes("=")) return;
  const found = new URLSearchParams(location.hash.slice(1)), number = (key) => { const value = Number(found.get(key)); return value > 0 && Number.isFinite(value) ? value : null; };
  const alpha = Number(found.get("a"));
  if (found.has("a") && alpha >= 0 && alpha <= 1) { alphaRange.step = "any"; alphaRange.value = alpha; }
  for (const [key, name] of [["l", "latency"], ["c", "cost"]])
    if (found.get(key) === "none" || number(key) !== null) limitControls[name].to(number(key));
  const radio = {near: "near", all: "all", hour: "per-hour"}[found.get("v")];
  if (radio) element(radio).checked = true;
}

alphaRange.addEventListener("input", () => update());
for (const id of ["near", "all", "per-hour"]) element(id).addEventListener("change", () => update());
addEventListener("hashchange", () => { restore(); update(false); });
element("back").addEventListener("click", () => {
  alphaRange.value = data.alpha;
  for (const one of Object.values(limitControls)) one.reset();
  state.pinned = [];
  update();
});
element("copy").addEventListener("click", async () => {
  try { await navigator.clipboard.writeText(element("command").textContent); element("copy").textContent = "Copied"; }
  catch { getSelection().selectAllChildren(element("command")); }
});
element("interactive").hidden = false;
restore();
update(false);
