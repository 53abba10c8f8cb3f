"use strict";
// On every report, also one without a menu: how old the prices are, which only a reader's clock can tell, and the curves.
const priced = document.getElementById("priced"), curves = document.getElementById("curves");
if (priced) {
  const days = Math.floor((Date.now() - Date.parse(priced.dateTime)) / 86400000);
  if (days >= 0) priced.textContent += ` (${days} day${days === 1 ? "" : "s"} old)`;
}
// What is folded on the screen is printed.
const folded = [...document.querySelectorAll("details:not(.code)")], opened = new Set();
addEventListener("beforeprint", () => { for (const one of folded) if (!one.open) { opened.add(one); one.open = true; } });
addEventListener("afterprint", () => { for (const one of opened) one.open = false; opened.clear(); });
if (curves) curves.addEventListener("change", () => curves.closest("figure").classList.toggle("curves", curves.checked));
