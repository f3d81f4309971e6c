"use strict";
const $ = (id) => document.getElementById(id);
let asked = 0;

async function ask(path, options = {}) {
  const token = sessionStorage.getItem("token");
  const headers = { ...options.headers };
  if (token) headers.Authorization = `Bearer ${token}`;
  const answer = await fetch(path, { ...options, headers });
  if (answer.status === 401) {
    sessionStorage.removeItem("token");
    $("unlock").hidden = false;
    $("token").focus();
  }
  if (!answer.ok) {
    const told = await answer.json().catch(() => ({ error: `the server answered ${answer.status}` }));
    throw new Error(told.error);
  }
  return answer;
}

function element(name, text, parent) {
  const made = document.createElement(name);
  if (text !== undefined) made.textContent = text;
  if (parent) parent.append(made);
  return made;
}

const numbers = (list, unit) => list.map((x) => x.toFixed(3)).join(" · ") + unit;

async function photo(card, hit, source) {
  const frame = element("div");
  frame.className = "photo";
  card.prepend(frame);
  try {
    const answer = await ask(`instances/${hit.instance_id}/crop.jpg?side=512&map_id=${source.map_id}`);
    const image = element("img");
    image.className = "photo";
    image.alt = `instance ${hit.instance_id} in ${hit.views[0]}`;
    image.src = URL.createObjectURL(await answer.blob());
    image.onload = () => URL.revokeObjectURL(image.src);
    frame.replaceWith(image);
  } catch { /* the photos have moved: the grey frame stays */ }
}

async function download(hit, source, format) {
  try {
    const answer = await ask(`instances/${hit.instance_id}/points?format=${format}&map_id=${source.map_id}`);
    const link = element("a");
    link.href = URL.createObjectURL(await answer.blob());
    link.download = `instance_${hit.instance_id}.${format}`;
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 10000);
  } catch (error) { $("told").textContent = error.message; }
}

function card(hit, source) {
  const unit = source.metric ? " m" : "";
  const made = element("article");
  const body = element("div", undefined, made);
  element("h2", hit.label || `instance ${hit.instance_id}`, body);
  const meter = element("meter", undefined, body);
  meter.value = hit.score;
  const facts = element("dl", undefined, body);
  const rows = [["score", hit.score.toFixed(2)], ["at", numbers(hit.centroid, unit)],
    ["box", numbers(hit.obb.extent, unit)], ["points", hit.num_points], ["id", hit.instance_id]];
  for (const [name, value] of rows) { element("dt", name, facts); element("dd", value, facts); }
  for (const format of ["ply", "npz"]) {
    const link = element("a", `points.${format}`, body);
    link.href = "#";
    link.onclick = (event) => { event.preventDefault(); download(hit, source, format); };
  }
  if (hit.views.length) photo(made, hit, source);
  return made;
}

async function search(text) {
  const mine = ++asked;
  $("told").textContent = "…";
  try {
    const options = { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify({ text, top_k: 6 }) };
    const answer = await (await ask("query", options)).json();
    if (mine !== asked) return;  // a newer question has been asked
    const result = answer.results[0];
    $("told").textContent = result.present ? "" : `“${text}” is not present`;
    $("hits").replaceChildren(...result.hits.map((hit) => card(hit, answer)));
  } catch (error) {
    if (mine === asked) { $("told").textContent = error.message; $("hits").replaceChildren(); }
  }
}

async function facts() {
  try {
    const health = await (await ask("health")).json();
    if (health.map === undefined) { $("unlock").hidden = false; return; }
    $("unlock").hidden = true;
    const trouble = health.problem ? ` — ${health.problem}` : "";
    $("map").textContent = `${health.map}: ${health.instances} instances, ${health.gaussians} Gaussians${trouble}`;
  } catch (error) { $("map").textContent = error.message; }
}

$("ask").onsubmit = (event) => { event.preventDefault(); search($("text").value); };
$("unlock").onsubmit = (event) => {
  event.preventDefault();
  sessionStorage.setItem("token", $("token").value.trim());
  $("token").value = "";
  $("told").textContent = "";
  facts();
};
facts();
