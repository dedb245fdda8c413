"use strict";
// Adds to a page that is complete without it: values under the pointer and arrow keys.
document.documentElement.classList.add("scripted");

document.querySelectorAll(".drawing").forEach((drawing) => {
  const { along, tips, cells } = JSON.parse(drawing.nextElementSibling.textContent);
  const svg = drawing.querySelector("svg"), readout = drawing.parentElement.querySelector(".readout");
  const ring = document.createElementNS("http://www.w3.org/2000/svg", "circle");
  ring.setAttribute("class", "ring");
  ring.setAttribute("r", 7);
  let at = -1;
  const say = (x, y, text) => {
    ring.setAttribute("cx", x);
    ring.setAttribute("cy", y);
    svg.append(ring);
    readout.textContent = text;
  };
  const go = (index) => { at = index; say(...tips[at]); };
  const distance = ([x, y], where) => Math.hypot(
    (x - where.x) * (along === "y" ? 0.05 : 1), (y - where.y) * (along === "x" ? 0.05 : 1));

  drawing.tabIndex = 0;
  const steps = { ArrowRight: 1, ArrowDown: 1, ArrowLeft: -1, ArrowUp: -1 };
  drawing.addEventListener("keydown", (event) => {
    if (!(event.key in steps)) return;
    event.preventDefault();
    if (tips.length) go((Math.max(at, steps[event.key] < 0 ? 0 : -1) + steps[event.key] + tips.length) % tips.length);
    else readout.textContent = "no spike differs";
  });
  drawing.addEventListener("pointermove", (event) => {
    const where = new DOMPoint(event.clientX, event.clientY).matrixTransform(svg.getScreenCTM().inverse());
    let near = -1;
    tips.forEach((tip, index) => {
      if (near < 0 || distance(tip, where) < distance(tips[near], where)) near = index;
    });
    if (near >= 0 && distance(tips[near], where) < (cells ? 4 : 24)) { go(near); return; }
    if (!cells) return;
    const column = Math.floor((where.x - cells.from[0]) / (cells.to[0] - cells.from[0]) * cells.columns);
    const row = Math.floor((where.y - cells.from[1]) / (cells.to[1] - cells.from[1]) * cells.rows.length);
    if (row in cells.rows && column >= 0 && column < cells.columns) say(where.x, where.y, `${cells.rows[row]}, step ${column}`);
  });
});
