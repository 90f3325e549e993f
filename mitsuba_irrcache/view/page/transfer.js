// <irrcache-transfer>: the editor of the transfer function.
//
// Opacity as a curve of points over a logarithmic histogram, colours as a band with stops under it.
// Points are dragged, added by a click and removed; the wheel zooms along the values. The viewer
// keeps the function and its history ("transfer", see view/transfer_panel.py); during a drag the
// points of this element are ahead of it.
"use strict";

(() => {
  const TOP = 6, PLOT = 108, BAND = 16, AXIS = 16, SIDE = 8;
  const HEIGHT = TOP + PLOT + BAND + 12 + AXIS, HIGHEST = 0.999;
  // The axis of opacities is their cube root: those of tissues lie between 0.001 and 0.1.
  const ROOT = 3, LINES = [0.01, 0.1, 0.5];
  const PATIENCE = 3000; // milliseconds; edits of other windows may replace one of this
  const HELP = "click: add a point; drag: move it; wheel: zoom";
  const clamp = (v, low, high) => Math.min(Math.max(v, low), high);
  const hex = (c) => `#${c.map((v) => Math.round(255 * v).toString(16).padStart(2, "0")).join("")}`;
  const rgb = (text) => [1, 3, 5].map((i) => parseInt(text.slice(i, i + 2), 16) / 255);

  /** Return the linear interpolation of points [x, y] with y a number or a list. */
  function interpolate(points, x) {
    const next = points.findIndex((p) => p[0] >= x);
    if (next < 0) return points[points.length - 1][1];
    if (next === 0) return points[0][1];
    const [a, b] = [points[next - 1], points[next]], t = (x - a[0]) / (b[0] - a[0]);
    const mix = (u, v) => u + (v - u) * t;
    return Array.isArray(a[1]) ? a[1].map((v, i) => mix(v, b[1][i])) : mix(a[1], b[1]);
  }

  class Transfer extends HTMLElement {
    connectedCallback() {
      this.innerHTML = `
        <canvas tabindex="0" role="application" aria-label="transfer function: opacity over value;
          arrow keys move the selected point, Delete removes it"></canvas>
        <div class="irrcache-row">
          <label><span data-id="unit">value</span><input type="number" step="any" data-id="value"></label>
          <label data-id="opacity-label">opacity<input type="number" min="0" max="0.999" step="0.01" data-id="opacity"></label>
          <label data-id="colour-label">colour<input type="color" data-id="colour"></label>
        </div>
        <div class="irrcache-row">
          <button data-id="remove" title="remove the selected point (Delete)">remove</button>
          <button data-id="undo" title="Ctrl+Z">undo</button>
          <button data-id="redo" title="Ctrl+Shift+Z">redo</button>
          <button data-id="whole" title="the axis shows all values; also by a double click on it">fit</button>
          <button data-id="load" title="a transfer function as JSON, from a file">load</button>
          <button data-id="save" title="JSON, for irrcache import">save</button>
        </div>
        <div class="irrcache-quiet" data-id="pointed"></div>`;
      this.canvas = this.querySelector("canvas");
      this.find = (name) => this.querySelector(`[data-id="${name}"]`);
      this.selected = { curve: "opacity", index: 0 };
      this.edited = irrcache.throttled("transfer");
      this.stop = irrcache.receive("transfer", (state) => this.take(state));
      this.addEvents();
      this.observer = new ResizeObserver(() => this.draw());
      this.observer.observe(this);
    }

    disconnectedCallback() {
      this.stop();
      this.observer.disconnect();
    }

    take(state) {
      const first = !this.state;
      this.state = state;
      const known = this.sent && state.edit !== this.sent.id && Date.now() < this.sent.until;
      if (!known && !this.drag) {
        this.points = { opacity: state.opacity, colour: state.colour };
        this.sent = null;
      }
      if (first) this.range = [...state.range];
      this.select(this.selected.curve, this.selected.index);
    }

    // ------------------------------------------------------------------ geometry

    get width() { return this.canvas.clientWidth || 280; }
    x(value) {
      const [low, high] = this.range;
      return SIDE + ((value - low) / (high - low)) * (this.width - 2 * SIDE);
    }
    y(opacity) { return TOP + (1 - opacity ** (1 / ROOT)) * PLOT; }
    value(x) {
      const [low, high] = this.range;
      return low + ((x - SIDE) / (this.width - 2 * SIDE)) * (high - low);
    }
    opacity(y) { return Math.min(clamp(1 - (y - TOP) / PLOT, 0, 1) ** ROOT, HIGHEST); }

    /** Return what lies under the pointer: a curve, and the index of its point or -1. */
    hit(event) {
      const x = event.offsetX, y = event.offsetY;
      const curve = y > TOP + PLOT + 3 ? "colour" : "opacity";
      let best = [10, -1];
      this.points[curve].forEach(([value, height], index) => {
        const down = curve === "opacity" ? this.y(height) : y;
        const away = Math.hypot(this.x(value) - x, down - y);
        if (away <= best[0]) best = [away, index];
      });
      return { curve, index: best[1] };
    }

    // ------------------------------------------------------------------ drawing

    draw() {
      if (!this.points) return;
      const ratio = window.devicePixelRatio || 1, width = this.width;
      this.canvas.width = width * ratio;
      this.canvas.height = HEIGHT * ratio;
      this.canvas.style.height = `${HEIGHT}px`;
      const context = this.canvas.getContext("2d");
      context.scale(ratio, ratio);
      context.save();
      context.beginPath();
      context.rect(SIDE, 0, width - 2 * SIDE, HEIGHT);
      context.clip();
      this.drawHistogram(context);
      this.drawBand(context);
      context.restore();
      this.drawCurve(context);
      this.drawStops(context);
      this.drawAxis(context);
    }

    drawHistogram(context) {
      const { histogram, range } = this.state, step = (range[1] - range[0]) / histogram.length;
      context.fillStyle = "#20242a";
      context.fillRect(SIDE, TOP, this.width - 2 * SIDE, PLOT);
      context.fillStyle = "#535c68";
      histogram.forEach((height, bin) => {
        const left = this.x(range[0] + bin * step), right = this.x(range[0] + (bin + 1) * step);
        context.fillRect(left, TOP + (1 - height) * PLOT, right - left + 0.5, height * PLOT);
      });
      context.strokeStyle = "#ffffff1c";
      for (const opacity of LINES) {
        context.strokeRect(SIDE, this.y(opacity), this.width - 2 * SIDE, 0);
      }
    }

    drawBand(context) {
      for (let x = SIDE; x < this.width - SIDE; x++) {
        context.fillStyle = hex(interpolate(this.points.colour, this.value(x)));
        context.fillRect(x, TOP + PLOT + 3, 1.5, BAND);
      }
    }

    drawCurve(context) {
      const points = this.points.opacity;
      context.save();
      context.beginPath();
      context.rect(SIDE - 6, 0, this.width - 2 * SIDE + 12, HEIGHT);
      context.clip();
      context.beginPath();
      context.moveTo(-10, this.y(interpolate(points, this.value(-10))));
      // Opacities are linear in the values, so that lines are curved on this axis.
      const inside = points.map(([value]) => this.x(value)).filter((x) => x > 0 && x < this.width);
      const places = [...Array(Math.ceil(this.width / 2)).keys()].map((n) => 2 * n).concat(inside);
      for (const x of places.sort((a, b) => a - b)) {
        context.lineTo(x, this.y(interpolate(points, this.value(x))));
      }
      context.strokeStyle = "#ffb14e";
      context.lineWidth = 2;
      context.stroke();
      points.forEach(([value, opacity], index) => {
        const chosen = this.selected.curve === "opacity" && this.selected.index === index;
        context.beginPath();
        context.arc(this.x(value), this.y(opacity), chosen ? 6 : 4.5, 0, 2 * Math.PI);
        context.fillStyle = hex(interpolate(this.points.colour, value));
        context.fill();
        context.strokeStyle = chosen ? "#fff" : "#ffb14e";
        context.stroke();
      });
      context.restore();
    }

    drawStops(context) {
      const down = TOP + PLOT + 3 + BAND;
      this.points.colour.forEach(([value, colour], index) => {
        const x = this.x(value);
        if (x < SIDE - 1 || x > this.width - SIDE + 1) return;
        const chosen = this.selected.curve === "colour" && this.selected.index === index;
        context.beginPath();
        context.moveTo(x, down - 4);
        context.lineTo(x + 5, down + 5);
        context.lineTo(x - 5, down + 5);
        context.closePath();
        context.fillStyle = hex(colour);
        context.fill();
        context.strokeStyle = chosen ? "#fff" : "#aaa";
        context.lineWidth = chosen ? 2 : 1;
        context.stroke();
      });
    }

    drawAxis(context) {
      const [low, high] = this.range, rough = (high - low) / 5, ten = 10 ** Math.floor(Math.log10(rough));
      const step = [1, 2, 5, 10].map((m) => m * ten).find((s) => s >= rough);
      context.fillStyle = "#a8b0ba";
      context.font = "10.5px system-ui, sans-serif";
      for (let value = Math.ceil(low / step) * step; value <= high; value += step) {
        const text = String(+value.toPrecision(6)), wide = context.measureText(text).width;
        const x = clamp(this.x(value) - wide / 2, 0, this.width - wide);
        context.fillText(text, x, HEIGHT - 3);
        context.fillRect(this.x(value), TOP + PLOT, 1, 3);
      }
      for (const opacity of LINES) {
        context.fillText(String(opacity), SIDE + 2, this.y(opacity) - 2);
      }
    }

    // ------------------------------------------------------------------ changes

    select(curve, index) {
      const points = this.points[curve];
      index = clamp(index, 0, points.length - 1);
      this.selected = { curve, index };
      const [value, height] = points[index], opacity = curve === "opacity";
      this.find("opacity-label").hidden = !opacity;
      this.find("opacity-label").title = `share of radiance lost over ${this.state.length}`;
      this.find("colour-label").hidden = opacity;
      this.find("unit").textContent = this.state.unit ? `value, ${this.state.unit}` : "value";
      this.fill("value", +value.toPrecision(6));
      if (opacity) this.fill("opacity", +height.toPrecision(3));
      else this.fill("colour", hex(height));
      this.find("remove").disabled = points.length <= 2;
      this.find("undo").disabled = !this.state.undo;
      this.find("redo").disabled = !this.state.redo;
      this.point();
      this.draw();
    }

    /** Fill a field unless the user is typing into it. */
    fill(name, value) {
      const field = this.find(name);
      if (document.activeElement !== field || field.type === "color") field.value = value;
    }

    /** Change the selected point, between its neighbours, and tell the viewer. */
    move(value, height, done) {
      const { curve, index } = this.selected, points = this.points[curve].map((p) => [...p]);
      const gap = 1e-6 * (this.state.range[1] - this.state.range[0]);
      const low = index ? points[index - 1][0] + gap : -Infinity;
      const high = index + 1 < points.length ? points[index + 1][0] - gap : Infinity;
      points[index] = [clamp(value, low, high), height];
      this.points[curve] = points;
      this.tell(done);
    }

    add(curve, value, height) {
      const points = this.points[curve].map((p) => [...p]);
      let index = points.findIndex((p) => p[0] > value);
      if (index < 0) index = points.length;
      points.splice(index, 0, [value, height]);
      this.points[curve] = points;
      this.selected = { curve, index };
    }

    remove() {
      const { curve, index } = this.selected;
      if (this.find("remove").disabled) return;
      this.points[curve] = this.points[curve].filter((_, i) => i !== index);
      this.tell(true);
    }

    /** Send the function; `done` ends a step of the history. */
    tell(done) {
      // Until the viewer has answered this edit, its answers to earlier ones are out of date.
      this.sent = { id: Math.floor(1e9 * Math.random()), until: Date.now() + PATIENCE };
      this.edited({ opacity: this.points.opacity, colour: this.points.colour, done, id: this.sent.id });
      this.select(this.selected.curve, this.selected.index);
    }

    zoom(event) {
      event.preventDefault();
      event.stopPropagation();
      const at = this.value(event.offsetX), factor = event.deltaY > 0 ? 1.25 : 0.8;
      const [low, high] = this.state.range;
      const width = clamp((this.range[1] - this.range[0]) * factor, 1e-4 * (high - low), high - low);
      const share = (at - this.range[0]) / (this.range[1] - this.range[0]);
      this.show(at - share * width, width);
    }

    /** Show values from `first`, within the range of the data. */
    show(first, width) {
      const [low, high] = this.state.range, start = clamp(first, low, high - width);
      this.range = [start, start + width];
      this.draw();
    }

    // ------------------------------------------------------------------ events

    addEvents() {
      const canvas = this.canvas;
      canvas.addEventListener("wheel", (event) => this.zoom(event), { passive: false });
      canvas.addEventListener("pointerdown", (event) => this.press(event));
      canvas.addEventListener("pointermove", (event) => this.drags(event));
      canvas.addEventListener("pointerup", (event) => this.release(event));
      canvas.addEventListener("pointercancel", () => (this.drag = null));
      canvas.addEventListener("pointerleave", () => {
        this.pointer = undefined;
        this.point();
      });
      canvas.addEventListener("contextmenu", (event) => this.menu(event));
      canvas.addEventListener("dblclick", (event) => this.twice(event));
      this.addEventListener("keydown", (event) => this.key(event));
      const height = () => this.points[this.selected.curve][this.selected.index][1];
      const value = () => this.points[this.selected.curve][this.selected.index][0];
      const number = (name, apply) => this.find(name).addEventListener("change", (event) => {
        if (event.target.value !== "") apply(Number(event.target.value));
      });
      number("value", (v) => this.move(v, height(), true));
      number("opacity", (v) => this.move(value(), clamp(v, 0, HIGHEST), true));
      const colour = this.find("colour");
      colour.addEventListener("input", () => this.move(value(), rgb(colour.value), false));
      colour.addEventListener("change", () => this.move(value(), rgb(colour.value), true));
      this.find("remove").addEventListener("click", () => this.remove());
      this.find("undo").addEventListener("click", () => irrcache.send("undo", null));
      this.find("redo").addEventListener("click", () => irrcache.send("redo", null));
      this.find("whole").addEventListener("click", () => this.whole());
      this.find("load").addEventListener("click", () => this.load());
      this.find("save").addEventListener("click", () => this.save());
    }

    load() {
      const chooser = Object.assign(document.createElement("input"), { type: "file", accept: ".json" });
      chooser.addEventListener("change", async () => {
        const file = chooser.files[0];
        if (file) irrcache.send("load", { name: file.name, text: (await file.text()).slice(0, 1 << 18) });
      });
      chooser.click();
    }

    save() {
      const url = URL.createObjectURL(new Blob([this.state.json], { type: "application/json" }));
      const link = Object.assign(document.createElement("a"), { href: url, download: "transfer_function.json" });
      link.click();
      window.setTimeout(() => URL.revokeObjectURL(url), 1000);
    }

    whole() {
      this.range = [...this.state.range];
      this.draw();
    }

    press(event) {
      if (event.button !== 0) return;
      this.canvas.setPointerCapture(event.pointerId);
      const hit = this.hit(event);
      this.drag = { hit, x: event.offsetX, y: event.offsetY, range: this.range, moved: false };
      if (hit.index >= 0) this.select(hit.curve, hit.index);
    }

    drags(event) {
      if (!this.points) return;
      const value = this.value(event.offsetX);
      this.pointer = event.offsetX;
      this.point();
      const drag = this.drag;
      if (!drag) {
        this.canvas.style.cursor = this.hit(event).index >= 0 ? "grab" : "crosshair";
        return;
      }
      if (!drag.moved && Math.hypot(event.offsetX - drag.x, event.offsetY - drag.y) < 3) return;
      drag.moved = true;
      if (drag.hit.index >= 0) {
        const old = this.points[drag.hit.curve][drag.hit.index][1];
        this.move(value, drag.hit.curve === "opacity" ? this.opacity(event.offsetY) : old, false);
      } else {
        const width = drag.range[1] - drag.range[0];
        const shift = ((event.offsetX - drag.x) / (this.width - 2 * SIDE)) * width;
        this.show(drag.range[0] - shift, width);
      }
    }

    /** Write the value under the pointer and its opacity below the plot, or else what the mouse does. */
    point() {
      let text = HELP;
      if (this.pointer !== undefined) {
        const value = this.value(this.pointer);
        const opacity = interpolate(this.points.opacity, value);
        text = `${+value.toPrecision(4)} ${this.state.unit}, opacity ${+opacity.toPrecision(2)}`;
      }
      this.find("pointed").textContent = text;
    }

    release(event) {
      const drag = this.drag;
      this.drag = null;
      if (!drag) return;
      if (drag.moved) {
        if (drag.hit.index >= 0) this.tell(true);
      } else if (drag.hit.index < 0) {
        const value = this.value(event.offsetX), band = drag.hit.curve === "colour";
        this.add(drag.hit.curve, value,
          band ? interpolate(this.points.colour, value) : this.opacity(event.offsetY));
        this.tell(true);
      }
    }

    menu(event) {
      event.preventDefault();
      const hit = this.hit(event);
      if (hit.index < 0) return;
      this.select(hit.curve, hit.index);
      this.remove();
    }

    twice(event) {
      const hit = this.hit(event);
      if (event.offsetY > HEIGHT - AXIS) this.whole();
      else if (hit.curve === "colour" && hit.index >= 0) this.find("colour").click();
    }

    key(event) {
      if (event.target !== this.canvas) return;
      const [value, height] = this.points[this.selected.curve][this.selected.index];
      const step = (this.range[1] - this.range[0]) / 200, opacity = this.selected.curve === "opacity";
      const moves = { ArrowLeft: [-step, 0], ArrowRight: [step, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
      if (event.key === "Delete" || event.key === "Backspace") this.remove();
      else if (event.key in moves) {
        const [along, up] = moves[event.key];
        this.move(value + along, opacity ? this.opacity(this.y(height) + up) : height, true);
      } else return;
      event.preventDefault();
      event.stopPropagation();
    }
  }

  customElements.define("irrcache-transfer", Transfer);

  // Keys with Ctrl or Alt are no movements of viser's camera, whose handler follows this one.
  document.addEventListener("keydown", (event) => {
    if (!(event.ctrlKey || event.metaKey || event.altKey)) return;
    event.stopImmediatePropagation();
    const editor = document.querySelector("irrcache-transfer"), target = event.target;
    const key = event.key.toLowerCase(), types = target.matches("input, textarea");
    if (key === "a" && !types) event.preventDefault(); // would mark all labels
    if (key !== "z" || event.altKey || !editor) return;
    if (types && !editor.contains(target)) return; // undoes typing
    irrcache.send(event.shiftKey ? "redo" : "undo", null);
    event.preventDefault();
  });
})();
