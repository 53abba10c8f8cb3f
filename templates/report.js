"use strict";
// The menu under other weights and limits: the rule of `fogspec menu`, over the numbers in this page.
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

function decide(alpha, latencyLimit, cost) {
  const latency = latencyLimit === null ? null : latencyLimit - data.network;
  const bounds = boundsOf(latency, cost);
  const {meets, floor} = feasibleUnder(bounds, latency, cost);
  const scaleX = data.scale.x || (data.metric ? null : latency) || data.scale.best_x;
  const scaleCost = data.scale.cost || cost || data.scale.best_cost;
  const objective = offers.x.map((x, i) => alpha * x / scaleX + (1 - alpha) * offers.cost[i] / scaleCost);
  const measured = meets.map((one, i) => one && offers.measured[i] === 1);
  const pool = data.adaptive && measured.includes(true) ? measured : meets;
  const found = {balanced: firstBy(objective, pool), cheapest: firstBy(offers.cost, pool), fastest: firstBy(offers.latency, pool)};
  return {...found, objective, meets, floor, scaleX, scaleCost, misses: found.balanced === null ? misses(bounds) : []};
}

// ---- words ------------------------------------------------------------------------------------------------------

const trim = (text) => (text.includes(".") ? text.replace(/\.?0+$/, "") : text);
const digits = (value, n) => {
  if (!(value > 0)) return "0";
  return trim(value.toFixed(Math.max(0, Math.min(20, n - 1 - Math.floor(Math.log10(value))))));
};
const money = (usd) => "$" + digits(usd, 3);
const duration = (s) => (s < 0.001 ? digits(s * 1e6, 3) + " µs" : s < 1 ? digits(s * 1000, 3) + " ms" : digits(s, 4) + " s");
const amount = (value) => (data.metric ? digits(value, 4) + (data.unit ? " " + data.unit : "") : duration(value));
const plain = (value) => (/e/.test(String(value)) ? digits(value, 12) : String(value));

function described(i) {
  const gpu = offers.gpu[i] ? ", " + offers.gpu[i] : "";
  return `${offers.name[i]}${offers.spot[i] ? " spot" : ""} (${offers.vcpus[i]} vCPU, ${digits(offers.memory[i], 4)} GiB${gpu})`;
}

// ---- controls ---------------------------------------------------------------------------------------------------

const element = (id) => document.getElementById(id);
const STEPS = 1000;

function limitControl(name, column) {
  const use = element(name + "-use"), range = element(name + "-range"), number = element(name + "-number");
  const set = data.limits[name], values = column.concat(set ? [set] : []).filter((v) => v > 0);
  const low = Math.log(Math.min(...values) / 1.5), high = Math.log(Math.max(...values) * 1.5);
  const place = (value) => Math.round((Math.log(value) - low) / (high - low) * STEPS);
  const start = set === null ? Math.exp((low + high) / 2) : set;
  const reset = () => {
    use.checked = set !== null;
    number.value = set === null ? digits(start, 3) : plain(start);
    range.value = place(start);
  };
  range.max = STEPS;
  reset();
  range.addEventListener("input", () => {
    number.value = digits(Math.exp(low + (range.value / STEPS) * (high - low)), 3);
    use.checked = true;
    update();
  });
  number.addEventListener("input", () => {
    if (Number(number.value) > 0) { range.value = place(Number(number.value)); use.checked = true; }
    update();
  });
  use.addEventListener("change", update);
  return {
    reset,
    value: () => (use.checked && Number(number.value) > 0 ? Number(number.value) : null),
    say: (words) => range.setAttribute("aria-valuetext", words),
  };
}

const latencyControl = limitControl("latency", offers.latency), costControl = limitControl("cost", offers.cost);
const alphaRange = element("alpha");
alphaRange.step = Number.isInteger(data.alpha * 100) ? "0.01" : "any";
alphaRange.value = data.alpha;

function update() {
  const alpha = Number(alphaRange.value), latency = latencyControl.value(), cost = costControl.value();
  const answer = decide(alpha, latency, cost);
  const words = `${alpha.toFixed(2)} ${data.metric || "latency"} + ${(1 - alpha).toFixed(2)} cost`;
  element("alpha-words").textContent = words;
  alphaRange.setAttribute("aria-valuetext", words);
  const latencyWords = latency === null ? "no limit" : "at most " + duration(latency);
  const costWords = cost === null ? "no limit" : `at most ${money(cost)}`;
  element("latency-words").textContent = latencyWords;
  element("cost-words").textContent = costWords;
  latencyControl.say(latencyWords);
  costControl.say(costWords);
  showAnswer(answer);
  showCommand(alpha, latency, cost);
  draw(answer, latency === null ? null : latency - data.network, cost);
}

function showAnswer(answer) {
  const verdict = element("verdict"), chosen = answer.balanced;
  verdict.dataset.chosen = chosen === null ? "" : offers.name[chosen];
  verdict.dataset.infra = chosen === null ? "" : offers.infra[chosen];
  const number = answer.meets.filter(Boolean).length;
  const total = data.complete ? `${number} of ${count} machine types meet the limits` : "";
  if (chosen === null) {
    const words = answer.misses.map((one) => `${one.name}: the best machine needs ${trim(one.factor.toPrecision(3))} times the limit (${one.name_of})`);
    if (!count) verdict.textContent = "Nothing can be said of any machine: no sample counts, or each admissible machine failed.";
    else verdict.textContent = words.length ? "No machine meets the limits: " + words.join("; ") + "." : "No machine is likely enough to meet the limits.";
  } else {
    const unsure = answer.floor !== null && answer.floor < data.confidence
      ? ` No machine meets the limits with probability ${data.confidence}: this is the best of those more likely to meet them than not.` : "";
    verdict.textContent = `Chosen: ${described(chosen)} in ${offers.infra[chosen]}. ${total ? total + "." : ""}${unsure}`;
  }
  const body = element("answers");
  body.replaceChildren();
  body.closest(".wide").hidden = chosen === null;
  if (chosen === null) return;
  for (const [role, i] of [["chosen", chosen], ["cheapest", answer.cheapest], ["fastest", answer.fastest]]) {
    const interval = offers.low[i] === null ? "" : ` [${amount(offers.low[i])}, ${amount(offers.high[i])}]`;
    const row = body.insertRow(), head = document.createElement("th");
    head.scope = "row";
    head.textContent = role;
    row.append(head);
    row.dataset.role = role;
    row.dataset.name = offers.name[i];
    row.dataset.row = offers.row[i];
    const cells = [described(i), offers.infra[i], amount(offers.x[i]) + interval, money(offers.cost[i]),
      money(offers.price[i]), money(offers.price[i] * 730), digits(answer.objective[i], 4), offers.measured[i] ? "measured" : "predicted"];
    for (const words of cells) row.insertCell().textContent = words;
  }
}

function showCommand(alpha, latency, cost) {
  const limit = (value, written) => (value === null ? "none" : written);
  element("command").textContent = `${data.command} --alpha ${plain(alpha)} --latency ${limit(latency, plain(latency) + "s")} ` +
    `--cost ${limit(cost, `'$${plain(cost)}/request'`)}`;
}

alphaRange.addEventListener("input", update);
for (const id of ["per-request", "per-hour"]) element(id).addEventListener("change", update);
new ResizeObserver(([one]) => { if (widthFor(one.contentRect.width) !== width) update(); }).observe(element("picture"));
element("back").addEventListener("click", () => {
  alphaRange.value = data.alpha;
  latencyControl.reset();
  costControl.reset();
  update();
});
element("interactive").hidden = false;
update();
