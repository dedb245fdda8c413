"use strict";
// Adds to a page that is complete without it: one raster at a time, and values under pointer and arrow keys.
document.documentElement.classList.add("scripted");

const chooser = document.getElementById("layer");
if (chooser) {
  const show = () => document.querySelectorAll("figure[data-raster]").forEach((figure) => {
    figure.hidden = figure.dataset.raster !== chooser.value;
  });
  chooser.addEventListener("change", show);
  show();
}

const readout = (svg) => svg.closest("figure").querySelector(".readout");

// Any figure whose shapes have tips: arrow keys walk through them.
function walk(svg) {
  const marks = [...svg.querySelectorAll(".v")];
  let at = -1;
  const go = (next) => {
    if (marks[at]) marks[at].classList.remove("at");
    at = next;
    if (!marks[at]) return;
    marks[at].classList.add("at");
    readout(svg).textContent = marks[at].querySelector("title").textContent;
  };
  keys(svg, (step) => go((Math.max(at, step < 0 ? 0 : -1) + step + marks.length) % marks.length));
  svg.addEventListener("pointerover", (event) => {
    const next = marks.indexOf(event.target);
    if (next >= 0) go(next);
  });
}

function keys(svg, go) {
  svg.setAttribute("tabindex", "0");
  const steps = { ArrowRight: 1, ArrowDown: 1, ArrowLeft: -1, ArrowUp: -1 };
  svg.addEventListener("keydown", (event) => {
    if (!(event.key in steps)) return;
    event.preventDefault();
    go(steps[event.key]);
  });
}

// A raster: the pointer reads any cell, arrow keys go from difference to difference.
function read(svg) {
  const { left, top, across, down, steps } = Object.fromEntries(
    ["left", "top", "across", "down", "steps"].map((name) => [name, Number(svg.dataset[name])]));
  const neurons = svg.dataset.neurons.split(" ").filter(Boolean);
  const cells = new Map();
  const path = (selector) => (svg.querySelector(selector) || { getAttribute: () => "" }).getAttribute("d");
  for (const [, x, row, run] of path(".both path").matchAll(/M(\d+) (\d+)\.5h(\d+)/g)) {
    for (let i = 0; i < Number(run); i++) cells.set(Number(row) * steps + Number(x) + i, "both fire");
  }
  for (const [side, dx, dy, words] of [["float", 3, 0, "the float model fires, the chip does not"],
    ["chip", 0, 3, "the chip fires, the float model does not"]]) {
    for (const [, x, y] of path(`.only-${side}`).matchAll(/M([\d.]+) ([\d.]+)/g)) {
      const step = Math.round((Number(x) + dx - left) / across - 0.5);
      cells.set(Math.round((Number(y) + dy - top) / down - 0.5) * steps + step, words);
    }
  }
  const differing = [...cells].filter(([, words]) => words !== "both fire").map(([cell]) => cell)
    .sort((a, b) => a % steps - b % steps || a - b);
  const cross = document.createElementNS("http://www.w3.org/2000/svg", "circle");
  cross.setAttribute("class", "cross");
  cross.setAttribute("r", 7);
  const point = (row, step) => {
    cross.setAttribute("cx", left + (step + 0.5) * across);
    cross.setAttribute("cy", top + (row + 0.5) * down);
    svg.append(cross);
    const who = `${svg.dataset.layer} ${svg.dataset.layer === "input" ? "channel" : "neuron"} ${neurons[row]}, step ${step}`;
    readout(svg).textContent = `${who}: ${cells.get(row * steps + step) || "silent"}`;
  };
  let at = -1;
  keys(svg, (step) => {
    if (!differing.length) { readout(svg).textContent = "no spike differs"; return; }
    at = (Math.max(at, step < 0 ? 0 : -1) + step + differing.length) % differing.length;
    point(Math.floor(differing[at] / steps), differing[at] % steps);
  });
  svg.addEventListener("pointermove", (event) => {
    const where = new DOMPoint(event.clientX, event.clientY).matrixTransform(svg.getScreenCTM().inverse());
    const row = Math.floor((where.y - top) / down), step = Math.floor((where.x - left) / across);
    if (row >= 0 && row < neurons.length && step >= 0 && step < steps) point(row, step);
  });
}

document.querySelectorAll("figure svg").forEach((svg) => (svg.classList.contains("raster") ? read(svg) : walk(svg)));
