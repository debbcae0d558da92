"use strict";
// Slices of stored maps: every block holds its numbers; nothing is fetched.
(() => {
  const VIRIDIS = ["440154", "482878", "3e4a89", "31688e", "26828e", "1f9e89", "35b779", "6dcd59", "b4de2c", "fde725"]
    .map((hex) => [0, 2, 4].map((k) => parseInt(hex.slice(k, k + 2), 16)));
  const spell = (value) => typeof value === "string" ? value : Number(value.toPrecision(5)).toString();

  function color(share) {
    const place = Math.min(Math.max(share, 0), 1) * (VIRIDIS.length - 1), k = Math.min(Math.floor(place), VIRIDIS.length - 2);
    return VIRIDIS[k].map((low, i) => Math.round(low + (place - k) * (VIRIDIS[k + 1][i] - low)));
  }

  function show(block) {
    const data = JSON.parse(block.querySelector("script").textContent);
    const bytes = Uint8Array.from(atob(data.values), (letter) => letter.charCodeAt(0));
    const values = new Float32Array(bytes.buffer);
    const [rows, columns] = [data.y.values.length, data.x.values.length];
    const canvas = block.querySelector("canvas"), readout = block.querySelector("output");
    const sliders = [...block.querySelectorAll("input")];
    canvas.width = columns; canvas.height = rows;
    const painter = canvas.getContext("2d");
    const at = { column: columns >> 1, row: rows >> 1 };
    const logarithmic = data.scale === "log";
    const share = (value) => logarithmic ? Math.log(value / data.low) / Math.log(data.high / data.low)
      : (value - data.low) / (data.high - data.low || 1);

    function offset() {
      return sliders.reduce((place, slider, k) => place * data.others[k].values.length + Number(slider.value), 0) * rows * columns;
    }
    function paint() {
      const image = painter.createImageData(columns, rows), start = offset();
      for (let row = 0; row < rows; row++) for (let column = 0; column < columns; column++) {
        const value = values[start + row * columns + column], k = 4 * ((rows - 1 - row) * columns + column);
        const rgb = Number.isNaN(value) ? [138, 138, 138] : color(share(value));
        image.data.set([...rgb, 255], k);
      }
      painter.putImageData(image, 0, 0);
      sliders.forEach((slider, k) => {
        const text = `${spell(data.others[k].values[slider.value])} ${data.others[k].unit}`.trim();
        slider.setAttribute("aria-valuetext", text);
        slider.parentElement.querySelector("span").textContent = text;
      });
      tell();
    }
    function tell() {
      const value = values[offset() + at.row * columns + at.column];
      const words = data.truth ? (value ? data.name : `not ${data.name}`) : Number.isNaN(value) ? "not known" : spell(value);
      readout.textContent = `${data.x.name} = ${spell(data.x.values[at.column])} ${data.x.unit}, `
        + `${data.y.name} = ${spell(data.y.values[at.row])} ${data.y.unit}: ${words} ${data.truth ? "" : data.unit}`;
    }
    sliders.forEach((slider) => slider.addEventListener("input", paint));
    canvas.addEventListener("pointermove", (event) => {
      const box = canvas.getBoundingClientRect();
      at.column = Math.min(columns - 1, Math.max(0, Math.floor((event.clientX - box.left) / box.width * columns)));
      at.row = Math.min(rows - 1, Math.max(0, rows - 1 - Math.floor((event.clientY - box.top) / box.height * rows)));
      tell();
    });
    canvas.addEventListener("keydown", (event) => {
      const step = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
      if (!step) return;
      event.preventDefault();
      at.column = Math.min(columns - 1, Math.max(0, at.column + step[0]));
      at.row = Math.min(rows - 1, Math.max(0, at.row + step[1]));
      tell();
    });
    paint();
  }
  document.querySelectorAll(".slices").forEach(show);
})();
