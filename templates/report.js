"use strict";
// Chooses as `fogspec menu` does (fogspec/choice/rule.py) among the machines of the table, from the numbers in `data`.
const element = (id) => document.getElementById(id);
const data = JSON.parse(element("data").textContent), rows = [...element("machines").tBodies[0].rows];
const machines = data.machines.map((numbers, i) => {
  const one = {row: rows[i], fixed: numbers.slice(data.columns.length)};
  data.columns.forEach((name, n) => { one[name] = numbers[n]; });
  return one;
});

// The standard normal distribution (Abramowitz and Stegun, 26.2.17), as fogspec computes it.
function normalBelow(z) {
  const a = Math.min(Math.abs(z), 40), t = 1 / (1 + 0.2316419 * a);
  const series = [-1.821255978, 1.781477937, -0.356563782, 0.31938153].reduce((sum, one) => (sum + one) * t, 1.330274429 * t);
  const tail = series * Math.exp(-0.5 * a * a) / Math.sqrt(2 * Math.PI);
  return z > 0 ? 1 - tail : tail;
}

// The latency that a limit on the cost of a request leaves, in seconds, of which `busy` is paid.
function secondsWithin(one, cost) {
  const left = cost - data.transfer, rate = data.interruptions_per_s;
  if (data.requests_per_s) return one.usd_per_s / data.requests_per_s <= left ? Infinity : 0;
  if (!one.usd_per_s) return left >= 0 ? Infinity : 0;
  const seconds = Math.max(left, 0) / one.usd_per_s;
  return (one.spot && rate > 0 ? Math.log1p(rate * seconds) / rate : seconds) / one.busy;
}

// The latency of requests one after the other for that at the declared rate, in seconds (fogspec/numerics/waiting.py).
function alone(one, latency) {
  if (!data.waiting || latency === null) return latency;
  const table = data.waiting[one.table], last = table.length - 1, busyAlways = 1 / data.requests_per_s / one.busy, at = latency / busyAlways;
  if (at > table[last]) return latency / table[last];
  const n = Math.max(1, table.findIndex((one) => one >= at));
  return busyAlways * (n - 1 + (at - table[n - 1]) / (table[n] - table[n - 1])) / last;
}

// The limits that the predicted values of a machine break.
function broken(one, limits) {
  const held = (value, most) => most === null || (value !== null && value <= most);
  return [["latency", one.latency, limits.latency], ["cost", one.cost, limits.cost], ["rate", alone(one, one.latency) * one.busy, limits.rate],
    ...data.fixed.map(([name, most], n) => [name, one.fixed[n], most])].filter(([, value, most]) => !held(value, most)).map(([name]) => name);
}

// The probability that another server of the machine's type meets all limits.
function probability(one, limits) {
  const rate = limits.rate === null ? null : limits.rate / one.busy;
  const most = Math.min(...[alone(one, limits.latency), rate].filter((bound) => bound !== null), limits.cost === null ? Infinity : secondsWithin(one, limits.cost));
  const off = Math.log(broken(one, limits).includes("price") ? 0 : most) - one.mu;
  const below = (1 - one.tail) * normalBelow(off / one.sigma) + one.tail * normalBelow(off / Math.hypot(one.sigma, one.spread));
  return Number(below.toPrecision(9)) * one.met;
}

// The machines with the smallest objective first: equal ones by cost, latency, and name.
function best(pool, objective) {
  const least = Math.min(...pool.map(objective)), tied = pool.filter((one) => objective(one) <= least + data.tie * Math.abs(least));
  return tied.sort((a, b) => a.cost - b.cost || a.latency - b.latency || a.order - b.order)[0] ?? null;
}

let limited = false; // whether there is any limit

// The choice for a weight and limits, null for none: in seconds with the network's allowance, and USD per request.
function choose(alpha, latency, cost) {
  const limits = {latency: latency === null ? null : latency - data.network, cost, rate: data.requests_per_s ? 1 / data.requests_per_s : null};
  limited = data.fixed.length > 0 || [limits.latency, limits.rate, cost].some((one) => one !== null);
  for (const one of machines) {
    one.broken = broken(one, limits);
    one.p = one.sigma > 0 ? probability(one, limits) : null; // else nothing tells it
    one.meets = !one.broken.length && (!limited || data.required === null || (one.p !== null && one.p >= data.required));
  }
  const meets = machines.filter((one) => one.meets), measured = meets.filter((one) => one.measured);
  const scale = data.scale.value || (data.metric ? null : limits.latency) || data.scale.best_value, ofCost = data.scale.cost || cost || data.scale.best_cost;
  for (const one of machines) one.objective = alpha * one.value / scale + (1 - alpha) * one.cost / ofCost;
  return {chosen: best(data.measured_first && measured.length ? measured : meets, (one) => one.objective), meets};
}

// ---- the controls and what they show ----------------------------------------------------------------------------

const cell = (one, name) => one.row.querySelector(`[data-head="${name}"]`).textContent;
const floored = (p) => String(Math.floor(1000 * (limited ? Math.min(p, data.most_certain) : p)) / 1000); // no model is certain
const typed = (id) => (Number(element(id).value) > 0 ? Number(element(id).value) : null);
const exact = (value) => Number(value.toPrecision(12));

function update() {
  const alpha = Number(element("alpha").value), latency = typed("latency"), per = typed("cost"), usd = per === null ? null : exact(per / data.per);
  const {chosen, meets} = choose(alpha, latency, usd), verdict = element("verdict");
  const order = [...machines].sort((a, b) => (b === chosen) - (a === chosen) || b.meets - a.meets || a.objective - b.objective || a.order - b.order);
  for (const one of order) {
    one.row.className = one === chosen ? "chosen" : one.meets ? "" : "misses";
    one.row.cells[0].textContent = one === chosen ? ">" : one.meets ? "" : "-";
    if (one.p !== null) one.row.querySelector('[data-head="P"]').textContent = floored(one.p);
    element("machines").tBodies[0].append(one.row);
  }
  const figures = (one) => [data.heads.value, data.heads.cost, "price"].map((name) => cell(one, name) + (name === data.heads.cost ? ` ${name}` : "")).join(", ");
  const likely = best(machines, (one) => -one.p), counted = `${meets.length} of ${machines.length} machines ${meets.length === 1 ? "meets" : "meet"} the limits.`;
  verdict.dataset.chosen = chosen ? cell(chosen, "machine") : "";
  verdict.textContent = chosen
    ? `${chosen === first ? "Same choice" : "Changes to"}${chosen === first ? ":" : ""} ${cell(chosen, "machine")}: ${figures(chosen)}${chosen.p === null ? "" : `, P ${floored(chosen.p)}`}. ${counted}`
    : `No machine qualifies${likely && likely.p !== null ? `: ${cell(likely, "machine")} is most likely to meet the limits, with P ${floored(likely.p)} of the required ${data.required}` : ""}.`;
  element("alpha-words").textContent = `${alpha.toFixed(2)} ${data.metric || "latency"} + ${(1 - alpha).toFixed(2)} cost`;
  element("command").textContent = `${data.command} --alpha ${alpha} --latency ${latency === null ? "none" : `${latency}s`} --cost ${usd === null ? "none" : `'$${usd.toFixed(12).replace(/0+$/, "")}/request'`}`;
}

function reset() {
  element("alpha").value = data.alpha;
  element("latency").value = data.limits.latency ?? "";
  element("cost").value = data.limits.cost === null ? "" : exact(data.limits.cost * data.per);
  update();
}

const first = choose(data.alpha, data.limits.latency, data.limits.cost).chosen;
for (const id of ["alpha", "latency", "cost"]) element(id).addEventListener("input", update);
element("reset").addEventListener("click", reset);
for (const one of document.querySelectorAll(".interactive")) one.hidden = false;
reset();
