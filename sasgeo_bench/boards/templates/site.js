// SPDX-License-Identifier: Apache-2.0
// Sorting, filtering and turning pages of cases. Every page can be read without it.
"use strict";

document.documentElement.classList.add("js");

function keyOf(row, at, isNumber) {
  const cell = row.cells[at];
  if (cell.dataset.key !== undefined) return Number(cell.dataset.key);
  return isNumber ? NaN : cell.textContent.trim();
}

// What has no number stays last, whichever way is sorted; what is alike keeps its order.
function compare(a, b, sign) {
  if (typeof a === "string" || typeof b === "string") return sign * String(a).localeCompare(String(b), "en", { numeric: true });
  if (Number.isNaN(a) || Number.isNaN(b)) return Number(Number.isNaN(a)) - Number(Number.isNaN(b));
  return sign * (a - b);
}

// How tables are sorted and filtered stands in the address, so that what is seen can be linked.
const asked = new URLSearchParams(location.search);
function remember(name, value, isOld) {
  const others = asked.getAll(name).filter((one) => !isOld(one));
  asked.delete(name);
  for (const one of value ? [...others, value] : others) asked.append(name, one);
  const text = asked.toString();
  history.replaceState(null, "", `${location.pathname}${text && "?"}${text}${location.hash}`);
}

function nextOrder(head) {
  const before = head.getAttribute("aria-sort");
  if (before === "none") return head.classList.contains("num") ? "descending" : "ascending";
  return before === "ascending" ? "descending" : "ascending";
}

function sortBy(head, order) {
  const table = head.closest("table");
  const at = head.cellIndex;
  const isNumber = head.classList.contains("num");
  const sign = order === "ascending" ? 1 : -1;
  const body = table.tBodies[table.tBodies.length - 1]; // lines that stay above have one of their own
  const rows = Array.from(body.rows, (row) => ({ row, key: keyOf(row, at, isNumber) }));
  rows.sort((a, b) => compare(a.key, b.key, sign));
  body.append(...rows.map((item) => item.row));
  for (const other of table.tHead.rows[0].cells) other.setAttribute("aria-sort", other === head ? order : "none");
}

for (const button of document.querySelectorAll("thead button")) {
  const head = button.closest("th");
  const name = head.closest("table").getAttribute("aria-labelledby");
  button.addEventListener("click", () => {
    const order = nextOrder(head);
    sortBy(head, order);
    remember("sort", `${name}!${head.cellIndex}!${order}`, (one) => one.startsWith(`${name}!`));
  });
}
for (const [name, at, order] of asked.getAll("sort").map((one) => one.split("!"))) {
  const table = Array.from(document.querySelectorAll("table")).find((one) => one.getAttribute("aria-labelledby") === name);
  const head = table && table.tHead.rows[0].cells[Number(at)];
  if (head && ["ascending", "descending"].includes(order)) sortBy(head, order);
}

// Escape puts a tip away until the pointer or the focus moves on.
document.addEventListener("keydown", (event) => {
  if (event.key === "Escape") document.body.classList.add("calm");
});
for (const kind of ["pointerover", "focusin"]) {
  document.addEventListener(kind, () => document.body.classList.remove("calm"));
}

// What is filtered: cases and sections by what they say of themselves, else the lines of tables by their columns.
function filtered() {
  const cases = Array.from(document.querySelectorAll("article.case"), (part) => ({ part, facts: new Map(Object.entries(part.dataset)) }));
  if (cases.length) return { what: "cases", parts: cases };
  const groups = Array.from(document.querySelectorAll("section.group"), (part) => ({ part, facts: new Map(Object.entries(part.dataset)) }));
  if (groups.length) return { what: "tables", parts: groups };
  const lines = Array.from(document.querySelectorAll("table"), (table) => {
    const names = Array.from(table.tHead.rows[0].cells, (cell) => (cell.querySelector("button") || cell).textContent);
    return Array.from(table.querySelectorAll("tbody tr"), (part) => ({ part, facts: new Map(names.map((name, at) => [name, part.cells[at].textContent.trim()])) }));
  }).flat();
  return { what: "lines", parts: lines };
}

const form = document.querySelector("form.filter");
if (form) {
  const { what, parts } = filtered();
  const filter = () => {
    const wanted = Array.from(form.querySelectorAll("select"), (one) => [one.name, one.value]);
    let shown = 0;
    for (const { part, facts } of parts) {
      const fits = wanted.every(([name, value]) => !value || !facts.has(name) || facts.get(name) === value);
      if (what === "cases") part.classList.toggle("out", !fits); // of those left one alone is not hidden
      else part.hidden = !fits;
      shown += Number(fits);
    }
    form.querySelector("output").textContent = `${shown} of ${parts.length} ${what} shown`;
  };
  for (const one of form.querySelectorAll("select")) {
    const wanted = asked.get(one.name);
    if (Array.from(one.options, (option) => option.value).includes(wanted)) one.value = wanted;
  }
  form.hidden = false;
  form.addEventListener("submit", (event) => event.preventDefault());
  form.addEventListener("change", (event) => {
    remember(event.target.name, event.target.value, () => true);
    filter();
  });
  filter(); // a browser may keep what was chosen before
  // A link to what is filtered away shows it all the same.
  const reveal = () => {
    const found = location.hash && document.getElementById(location.hash.slice(1));
    const group = found && found.closest(".out, section.group[hidden]");
    if (group) {
      form.reset();
      for (const one of form.querySelectorAll("select")) remember(one.name, "", () => true);
      filter();
      found.scrollIntoView();
    }
  };
  addEventListener("hashchange", reveal);
}

const cases = Array.from(document.querySelectorAll("article.case"));
if (cases.length) {
  const left = () => cases.filter((one) => !one.classList.contains("out"));
  const current = () => Math.max(0, left().findIndex((one) => `#${one.id}` === location.hash));
  const show = (isAsked) => {
    const [kept, at] = [left(), current()];
    for (const one of cases) one.hidden = one !== kept[at];
    for (const section of document.querySelectorAll("main > section")) section.hidden = !section.querySelector("article:not([hidden])");
    for (const link of kept[at]?.querySelectorAll(".turn a") ?? []) {
      const next = kept[at + (link.rel === "next" ? 1 : -1)];
      link.hidden = !next;
      if (next) link.hash = next.id;
    }
    if (isAsked) kept[at]?.focus();
  };
  addEventListener("hashchange", () => show(true));
  form?.addEventListener("change", () => show(false));
  document.addEventListener("keydown", (event) => {
    const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
    const isTaken = event.altKey || event.ctrlKey || event.metaKey || event.shiftKey || event.target.closest("input, select, textarea");
    const next = step && !isTaken ? left()[current() + step] : undefined;
    if (next) {
      event.preventDefault();
      location.hash = next.id;
    }
  });
  show(false);
}
