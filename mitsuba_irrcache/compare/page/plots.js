// Values of the plots on hover.
//
// Input: <figure data-points="JSON"> around an SVG by matplotlib. The JSON maps the id of a group
// of markers to the texts of its markers, in their order; see compare/plots.py.
"use strict";

(() => {
  for (const figure of document.querySelectorAll("figure[data-points]")) {
    const marks = [];
    for (const [id, texts] of Object.entries(JSON.parse(figure.dataset.points))) {
      const markers = figure.querySelectorAll(`[id="${id}"] use`);
      const shapes = markers.length ? markers : figure.querySelectorAll(`[id="${id}"] > path`);
      texts.forEach((text, index) => shapes[index] && marks.push([shapes[index], text]));
    }
    const tip = figure.appendChild(document.createElement("div"));
    tip.className = "tip";
    tip.hidden = true;
    // Distance from a point to a box; 0 inside, so that bars are hit anywhere.
    const away = (box, x, y) => Math.hypot(
      Math.max(box.left - x, 0, x - box.right), Math.max(box.top - y, 0, y - box.bottom));
    figure.addEventListener("pointermove", (event) => {
      let best = [24, null, ""]; // pixels
      for (const [shape, text] of marks) {
        const box = shape.getBoundingClientRect();
        const distance = away(box, event.clientX, event.clientY);
        if (distance < best[0]) best = [distance, box, text];
      }
      tip.hidden = !best[1];
      if (!best[1]) return;
      const frame = figure.getBoundingClientRect();
      tip.textContent = best[2];
      tip.style.left = `${(best[1].left + best[1].right) / 2 - frame.left}px`;
      tip.style.top = `${best[1].top - frame.top}px`;
    });
    figure.addEventListener("pointerleave", () => (tip.hidden = true));
  }
})();
