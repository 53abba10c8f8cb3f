"use strict";
// On every report, also one without a menu: how old the prices are, which only a reader's clock can tell, and the curves.
const priced = document.getElementById("priced"), curves = document.getElementById("curves");
if (priced) {
  const days = Math.floor((Date.now() - Date.parse(priced.dateTime)) / 86400000);
  if (days >= 0) priced.textContent += ` (${days} day${days === 1 ? "" : "s"} old)`;
}
if (curves) curves.addEventListener("change", () => curves.closest("figure").classList.toggle("curves", curves.checked));
