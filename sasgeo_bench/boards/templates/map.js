// SPDX-License-Identifier: Apache-2.0
// The map page: queries of a place on its picture, one of them in detail, and the same part of the map at each pose.
"use strict";

const COLOURS = ["#009e73", "#cc3311", "#e69f00", "#882255", "#332288", "#56b4e9", "#999933", "#555555", "#7a5230", "#bbbbbb"];
const NOT_ASKED = 9; // of the outcomes: no failure
const TRUE = "#000000";
const SIDE_PX = 300;
const [ID, SUITE, REGION, KIND, PRESENT, VIEW_M, EAST] = [0, 1, 2, 3, 4, 5, 6]; // of a query
const choice = document.getElementById("choice");
const field = (name) => choice.elements[name];
const outcomes = Array.from(field("outcome").options, (one) => one.text).slice(2);
const wanted = new URLSearchParams(location.search);
const scripts = new Map(); // file -> content of a place
let place, answers, map, dots, detail, shown = [], at = -1;

function showPlace(file, content) { scripts.set(file, content); }

function load(file) {
  if (scripts.has(file)) return Promise.resolve(scripts.get(file));
  return new Promise((done, fail) => {
    const script = document.createElement("script");
    script.src = file;
    script.onload = () => (scripts.has(file) ? done(scripts.get(file)) : fail(new Error(file)));
    script.onerror = () => fail(new Error(file));
    document.head.append(script);
  });
}

function fill(select, names, all) {
  const before = wanted.get(select.name) ?? select.value;
  select.replaceChildren(...[...(all ? [[all, ""]] : []), ...names.map((name) => [name, name])].map(([text, value]) => new Option(text, value)));
  if (names.includes(before)) select.value = before;
}

function remember(query) {
  const said = new URLSearchParams();
  for (const name of ["place", "matcher", "suite", "outcome"]) if (field(name).value || name === "outcome") said.set(name, field(name).value);
  if (query) said.set("query", query);
  history.replaceState(null, "", `${location.pathname}?${said}`);
}

const latlng = (east, north) => L.latLng(north, east);

async function openPlace() {
  const option = field("place").selectedOptions[0];
  place = await load(option.dataset.file);
  answers = new Map(place.answers);
  fill(field("matcher"), [...answers.keys()], "");
  fill(field("suite"), [...new Set(place.queries.map((one) => one[SUITE]))].sort(), "all");
  if (!map) {
    map = L.map("map", { crs: L.CRS.Simple, minZoom: -5, maxZoom: 3, zoomSnap: 0.25, attributionControl: true });
    map.attributionControl.setPrefix("Leaflet").addAttribution({{ about.credit | e | tojson }});
    L.control.scale({ imperial: false, position: "topright" }).addTo(map);
  }
  map.eachLayer((layer) => layer.remove());
  const [width, height] = place.size_m;
  const bounds = L.latLngBounds(latlng(0, 0), latlng(width, height));
  L.imageOverlay(place.picture, bounds, { alt: `Map of ${option.text}` }).addTo(map);
  for (const [name, west, south, east, north] of place.blocks) {
    L.rectangle([latlng(west, south), latlng(east, north)], { color: "#444444", weight: 1, dashArray: "3 5", fill: false, interactive: false }).addTo(map).getElement()?.setAttribute("aria-label", `Block ${name}`);
  }
  dots = L.layerGroup().addTo(map);
  detail = L.layerGroup().addTo(map);
  map.setMaxBounds(bounds.pad(0.5)).fitBounds(bounds);
}

// The answers of a matcher that the filters leave, each with its query.
function chosen() {
  const [suite, outcome] = [field("suite").value, field("outcome").value];
  const fits = (kind) => outcome === "" || (outcome === "failures" ? kind !== 0 && kind !== NOT_ASKED : kind === Number(outcome));
  return (answers.get(field("matcher").value) || [])
    .map(([number, kind, ...fix]) => ({ number, kind, fix, query: place.queries[number] }))
    .filter((one) => fits(one.kind) && (!suite || one.query[SUITE] === suite));
}

function draw() {
  shown = chosen();
  at = -1;
  dots.clearLayers();
  shown.forEach((one, number) => {
    const where = one.query.length > EAST ? one.query.slice(EAST) : one.fix;
    if (!where.length) return;
    L.circleMarker(latlng(where[0], where[1]), { radius: 6, weight: 1.5, color: "#ffffff", fillColor: COLOURS[one.kind] || COLOURS[9], fillOpacity: 0.95 })
      .bindTooltip(document.createTextNode(`${one.query[SUITE]}, ${one.query[KIND]}: ${outcomes[one.kind] || "unknown"}`))
      .on("click", () => show(number))
      .addTo(dots);
  });
  for (const name of ["previous", "next"]) document.getElementById(name).disabled = !shown.length;
  const before = shown.findIndex((one) => one.query[ID] === wanted.get("query"));
  show(before >= 0 ? before : shown.length ? 0 : -1);
}

function row(name, value) {
  const line = document.createElement("div");
  const [term, text] = [document.createElement("dt"), document.createElement("dd")];
  term.textContent = name;
  text.textContent = value;
  line.append(term, text);
  return line;
}

// A part of the map around a pose, north up: one picture, shifted and enlarged.
function crop(title, pose, view_m, colour) {
  const figure = document.createElement("figure");
  const [box, words] = [document.createElement("div"), document.createElement("figcaption")];
  words.textContent = title;
  box.className = "crop";
  const scale = SIDE_PX / (2 * view_m); // the view is half as wide
  const [width, height] = place.size_m;
  box.style.backgroundImage = `url("${place.picture}")`;
  box.style.backgroundSize = `${width * scale}px ${height * scale}px`;
  box.style.backgroundPosition = `${SIDE_PX / 2 - pose[0] * scale}px ${SIDE_PX / 2 - (height - pose[1]) * scale}px`;
  box.style.setProperty("--turn", `${pose[2]}deg`);
  box.style.setProperty("--colour", colour);
  figure.append(box, words);
  return figure;
}

// Easting, northing and yaw in the grid of the map.
const spot = (pose) => `E ${(place.corner_m[0] + pose[0]).toFixed(1)} m, N ${(place.corner_m[1] + pose[1]).toFixed(1)} m, yaw ${pose[2].toFixed(0)} deg`;
const away = (one, other) => Math.hypot(one[0] - other[0], one[1] - other[1]);

function rivals(number) {
  const mine = field("matcher").value;
  const found = [...answers].filter(([name]) => name !== mine).map(([name, rows]) => {
    const row = rows.find((one) => one[0] === number);
    return row && { name, kind: row[1], fix: row.slice(2) };
  });
  // Who is right first: it shows best what was missed.
  return found.filter(Boolean).sort((a, b) => Number(a.kind !== 0) - Number(b.kind !== 0));
}

function show(number) {
  at = number;
  detail.clearLayers();
  const [facts, crops, more] = ["facts", "crops", "more"].map((id) => document.getElementById(id));
  for (const part of [facts, crops, more]) part.replaceChildren();
  document.getElementById("told").textContent = shown.length ? `${at + 1} of ${shown.length} queries` : "no such query here";
  document.getElementById("which").textContent = at < 0 ? "No query chosen" : outcomes[shown[at].kind] || "unknown";
  wanted.delete("query");
  remember(at < 0 ? "" : shown[at].query[ID]);
  if (at < 0) return;
  const { query, fix, kind, number: index } = shown[at];
  const matcher = field("matcher").value;
  const truth = query.slice(EAST);
  facts.append(row("Suite", `${query[SUITE]}, ${query[KIND]}`), row("Searched map", query[REGION] + (query[REGION] === field("place").value ? "" : `; the picture shows ${field("place").value}`)), row("Query", query[ID]));
  facts.append(row("Answer", !fix.length ? "none" : truth.length ? `${away(fix, truth).toFixed(1)} m from where the view was taken` : "given"));
  for (const [name, pose] of [["True place", truth], ["Answered place", fix]]) if (pose.length) facts.append(row(name, spot(pose)));
  if (!query[PRESENT]) facts.append(row("Place", "not on the searched map: the right answer is none"));
  if (truth.length) {
    L.circleMarker(latlng(...truth), { radius: 9, weight: 3, color: TRUE, fill: false }).bindTooltip("true place").addTo(detail);
    crops.append(crop("true place", truth, query[VIEW_M], TRUE));
  }
  if (fix.length) {
    L.circleMarker(latlng(...fix), { radius: 8, weight: 3, color: COLOURS[kind] || COLOURS[9], fill: false }).bindTooltip(document.createTextNode(matcher)).addTo(detail);
    if (truth.length) L.polyline([latlng(...truth), latlng(...fix)], { color: TRUE, weight: 2, dashArray: "4 4" }).addTo(detail);
    crops.append(crop(matcher, fix, query[VIEW_M], COLOURS[kind] || COLOURS[9]));
  }
  const others = rivals(index);
  for (const one of others.filter((other) => other.fix.length)) {
    L.circleMarker(latlng(...one.fix), { radius: 5, weight: 2, color: "#0072b2", fill: false }).bindTooltip(document.createTextNode(one.name)).addTo(detail);
  }
  const rival = others.find((one) => one.fix.length);
  if (rival) crops.append(crop(`${rival.name}: ${outcomes[rival.kind] || "unknown"}`, rival.fix, query[VIEW_M], "#0072b2"));
  if (others.length) facts.append(row("Others", others.map((one) => `${one.name}: ${outcomes[one.kind] || "unknown"}`).join("; ")));
  if (place.cases[index]) {
    const link = document.createElement("a");
    link.href = `failures.html#case-${place.cases[index]}`;
    link.textContent = "Its view and scores";
    more.append(link);
  }
  const points = [truth, fix].filter((one) => one.length).map((one) => latlng(...one));
  if (points.length && !points.every((one) => map.getBounds().contains(one))) map.fitBounds(L.latLngBounds(points).pad(0.6), { maxZoom: 0 });
}

const turn = (step) => { if (shown.length) show((at + step + shown.length) % shown.length); };

async function start() {
  for (const one of document.querySelectorAll(".swatch")) one.style.background = one.dataset.colour || COLOURS[one.dataset.outcome];
  for (const name of ["place", "outcome"]) {
    const value = wanted.get(name);
    if (Array.from(field(name).options, (one) => one.value).includes(value)) field(name).value = value;
  }
  choice.hidden = document.getElementById("browser").hidden = false;
  choice.addEventListener("submit", (event) => event.preventDefault());
  choice.addEventListener("change", async (event) => {
    wanted.delete(event.target.name);
    if (event.target.name === "place") await openPlace();
    draw();
  });
  document.getElementById("previous").addEventListener("click", () => turn(-1));
  document.getElementById("next").addEventListener("click", () => turn(1));
  await openPlace();
  if (!wanted.has("outcome") && !chosen().length) field("outcome").value = ""; // no failure to begin with
  draw();
}

start().catch((error) => { document.getElementById("told").textContent = `The map of this place cannot be loaded (${error.message}).`; });
