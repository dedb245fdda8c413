"use strict";
// Adds to a page that is complete without it: filters, values under pointer and arrow keys, commands of a kept point.
document.documentElement.classList.add("scripted");

const points = JSON.parse(document.getElementById("data").textContent);
const boxes = [...document.querySelectorAll("input[data-axis]")];
const all = (number) => document.querySelectorAll(`[data-n="${number}"]:not(button)`);

function filter() {
  const off = new Set(boxes.filter((box) => !box.checked).map((box) => `${box.dataset.axis} ${box.value}`));
  let shown = 0;
  for (const [number, point] of Object.entries(points)) {
    const gone = Object.entries(point.axes).some(([axis, value]) => off.has(`${axis} ${value}`));
    all(number).forEach((element) => element.classList.toggle("gone", gone));
    shown += gone ? 0 : 1;
  }
  const counted = document.getElementById("shown");
  if (counted) counted.textContent = `${shown} of ${Object.keys(points).length} points`;
}
boxes.forEach((box) => box.addEventListener("change", filter));

const axis = document.getElementById("axis");
const draw = () => document.querySelectorAll("#chart figure").forEach((figure) => {
  figure.hidden = figure.dataset.raster !== axis.value;
});
axis.addEventListener("change", draw);
draw();

function keep(number) {
  document.querySelectorAll(".kept").forEach((element) => element.classList.remove("kept"));
  all(number).forEach((element) => element.classList.add("kept"));
  const place = document.getElementById("chosen");
  const words = document.createElement("p");
  words.textContent = points[number].tip;
  const commands = document.createElement("pre");
  commands.textContent = points[number].commands.join("\n");
  place.replaceChildren(words, commands);
  return place;
}

document.querySelectorAll("button[data-n]").forEach((button) => button.addEventListener("click", () => {
  keep(button.dataset.n).scrollIntoView({ block: "nearest" });
}));

// Marks in the order of their cost, as far as the filters leave them.
document.querySelectorAll("#chart figure svg").forEach((svg) => {
  const readout = svg.closest("figure").querySelector(".readout");
  const place = (mark) => mark.getBBox().x;
  const marks = () => [...svg.querySelectorAll(".v:not(.gone)")].sort((a, b) => place(a) - place(b));
  let at = null;
  const go = (mark) => {
    if (at) at.classList.remove("at");
    at = mark;
    at.classList.add("at");
    readout.textContent = points[mark.dataset.n].tip;
  };
  svg.setAttribute("tabindex", "0");
  const steps = { ArrowRight: 1, ArrowUp: 1, ArrowLeft: -1, ArrowDown: -1 };
  svg.addEventListener("keydown", (event) => {
    const there = marks();
    if (event.key === "Enter" && at) keep(at.dataset.n);
    if (!(event.key in steps) || !there.length) return;
    event.preventDefault();
    const from = there.indexOf(at);
    go(there[from < 0 ? (steps[event.key] > 0 ? 0 : there.length - 1) : (from + steps[event.key] + there.length) % there.length]);
  });
  svg.addEventListener("pointerover", (event) => { if (event.target.dataset.n) go(event.target); });
  svg.addEventListener("click", (event) => { if (event.target.dataset.n) keep(event.target.dataset.n); });
});
