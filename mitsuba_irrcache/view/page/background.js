// <irrcache-background>: the colour behind the image, picked, or typed as a CSS colour.
"use strict";

(() => {
  /** Return [r, g, b] in [0, 1] of a CSS colour, null of other text. */
  function parsed(text) {
    if (!CSS.supports("color", text)) return null;
    const context = document.createElement("canvas").getContext("2d");
    context.fillStyle = text;
    context.fillRect(0, 0, 1, 1);
    return [...context.getImageData(0, 0, 1, 1).data.slice(0, 3)].map((v) => v / 255);
  }

  const hex = (colour) =>
    `#${colour.map((v) => Math.round(255 * v).toString(16).padStart(2, "0")).join("")}`;

  customElements.define("irrcache-background", class extends HTMLElement {
    connectedCallback() {
      this.innerHTML = `<div class="irrcache-row" title="where emitters are hidden, see the group Light">
          <span class="irrcache-quiet">background</span>
          <input type="color" value="#000000" aria-label="background: pick a colour">
          <input type="text" value="black" size="14" aria-label="background: a colour's name, or #rrggbb">
        </div><div class="irrcache-refused" hidden></div>`;
      const [picker, field] = this.querySelectorAll("input");
      const refused = this.querySelector(".irrcache-refused"), send = irrcache.throttled("background");
      const take = (text) => {
        const colour = parsed(text);
        refused.textContent = colour ? "" : `"${text}" is no colour: a name such as white, or #rrggbb`;
        refused.hidden = Boolean(colour);
        if (!colour) return;
        picker.value = hex(colour);
        if (picker !== document.activeElement) field.value = text;
        send(colour);
      };
      picker.addEventListener("input", () => { field.value = picker.value; take(picker.value); });
      field.addEventListener("change", () => take(field.value.trim()));
      this.stop = irrcache.receive("background", (colour) => {
        if (hex(colour) === picker.value) return;
        field.value = picker.value = hex(colour);
      });
    }
    disconnectedCallback() { this.stop(); }
  });
})();
