// <irrcache-light>: the direction of the sun, dragged on a sphere as seen by the camera.
"use strict";

(() => {
  const RADIUS = 30, SIZE = 2 * RADIUS + 12;

  class Light extends HTMLElement {
    connectedCallback() {
      this.innerHTML = `<canvas role="img" aria-label="direction to the sun, drag to change it"></canvas>
        <span><span class="irrcache-quiet" data-id="usage"></span>
        <span class="irrcache-row"><label title="azimuth, about the upward axis">azim. °<input
          type="number" step="1" min="-360" max="360" data-id="azimuth"></label><label
          title="elevation above the horizon">elev. °<input type="number" step="1" min="-90"
          max="90" data-id="elevation"></label></span></span>`;
      this.fields = [...this.querySelectorAll("input")];
      for (const field of this.fields) field.addEventListener("change", () => this.enter());
      this.canvas = this.querySelector("canvas");
      this.edited = irrcache.throttled("sun");
      this.stops = [
        irrcache.receive("lighting", (value) => { this.lighting = value; this.fill(); this.draw(); }),
        irrcache.receive("camera", (value) => { this.axes = value; this.draw(); }),
      ];
      this.canvas.addEventListener("pointerdown", (event) => {
        this.canvas.setPointerCapture(event.pointerId);
        this.dragging = true;
        this.move(event);
      });
      this.canvas.addEventListener("pointermove", (event) => this.dragging && this.move(event));
      for (const name of ["pointerup", "pointercancel"]) {
        this.canvas.addEventListener(name, () => (this.dragging = false));
      }
      this.draw();
    }

    disconnectedCallback() { this.stops.forEach((stop) => stop()); }

    /** Show how the sun is moved, and the angles in their fields, unless the user is typing into them. */
    fill() {
      this.querySelector("[data-id=usage]").textContent = this.lighting.sun > 0
        ? "drag; Shift: behind (dashed)" : "no sun: drag to add one";
      for (const field of this.fields) {
        if (field !== document.activeElement) field.value = Math.round(this.lighting[field.dataset.id]);
      }
    }

    /** Send the angles in the fields, if both are allowed. */
    enter() {
      if (this.fields.some((field) => field.value === "" || !field.checkValidity())) {
        for (const field of this.fields) field.reportValidity();
        return;
      }
      const [azimuth, elevation] = this.fields.map((field) => Number(field.value));
      irrcache.send("angles", { azimuth, elevation });
    }

    /** Set the direction under the pointer: on the half towards the camera, or behind it. */
    move(event) {
      if (!this.axes) return;
      let x = (event.offsetX - SIZE / 2) / RADIUS, y = (SIZE / 2 - event.offsetY) / RADIUS;
      const away = Math.hypot(x, y);
      if (away > 1) { x /= away; y /= away; }
      const z = Math.sqrt(Math.max(0, 1 - x * x - y * y)) * (event.shiftKey ? 1 : -1);
      const [right, up, forward] = this.axes;
      const towards = [0, 1, 2].map((i) => x * right[i] + y * up[i] + z * forward[i]);
      this.lighting = { ...this.lighting, towards };
      this.edited(towards);
      this.draw();
    }

    draw() {
      const ratio = window.devicePixelRatio || 1, context = this.canvas.getContext("2d");
      this.canvas.width = this.canvas.height = SIZE * ratio;
      this.canvas.style.width = this.canvas.style.height = `${SIZE}px`;
      context.scale(ratio, ratio);
      context.translate(SIZE / 2, SIZE / 2);
      const shade = context.createRadialGradient(0, 0, 4, 0, 0, RADIUS);
      shade.addColorStop(0, "#4a525c");
      shade.addColorStop(1, "#2a2f36");
      context.fillStyle = shade;
      context.beginPath();
      context.arc(0, 0, RADIUS, 0, 2 * Math.PI);
      context.fill();
      if (!this.axes || !this.lighting) return;
      const dot = (a, b) => a.reduce((sum, v, i) => sum + v * b[i], 0);
      const [x, y, z] = this.axes.map((axis) => dot(axis, this.lighting.towards));
      const on = this.lighting.sun > 0;
      context.strokeStyle = context.fillStyle = on ? "#ffd166" : "#8b929b";
      context.setLineDash(z > 0 ? [3, 3] : []);
      context.beginPath();
      context.moveTo(0, 0);
      context.lineTo(x * RADIUS, -y * RADIUS);
      context.stroke();
      context.beginPath();
      context.arc(x * RADIUS, -y * RADIUS, 5, 0, 2 * Math.PI);
      if (z > 0) context.stroke();
      else context.fill();
    }
  }

  customElements.define("irrcache-light", Light);
})();
