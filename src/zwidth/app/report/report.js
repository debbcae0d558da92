"use strict";
// Draw the maps of the report. Each block contains its values as JSON; the script loads nothing from a network.
(() => {
  const spell = (value, digits = 6) => typeof value === "string" ? value : Number(value.toPrecision(digits)).toString();

  function show(block) {
    const data = JSON.parse(block.querySelector("script").textContent);
    const decode = (text) => new Float32Array(Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0)).buffer);
    const values = decode(data.values);
    const [rows, columns] = [data.y.values.length, data.x.values.length];
    const canvas = block.querySelector("canvas"), readout = block.querySelector("output");
    const sliders = [...block.querySelectorAll("input")];
    const small = document.createElement("canvas");
    small.width = columns; small.height = rows;
    const painter = small.getContext("2d"), pen = canvas.getContext("2d");
    const at = { column: columns >> 1, row: rows >> 1 };
    const box = { left: 70, top: 12, right: 78, bottom: 44 };
    const colors = data.colors.map((hex) => [0, 2, 4].map((k) => parseInt(hex.slice(k, k + 2), 16)));
    function color(share) {
      const place = Math.min(Math.max(share, 0), 1) * (colors.length - 1), k = Math.min(Math.floor(place), colors.length - 2);
      return colors[k].map((low, i) => Math.round(low + (place - k) * (colors[k + 1][i] - low)));
    }
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
        // Draw values up to 0 in gray, because a logarithmic scale cannot show them.
        const rgb = Number.isFinite(value) && !(logarithmic && value <= 0) ? color(share(value)) : [138, 138, 138];
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
    // Return the position of a value on an axis, in cells: from 0 to the number of cells.
    function place(steps, value) {
      const up = steps[steps.length - 1] >= steps[0];
      let k = steps.findIndex((step) => up ? step > value : step < value);
      k = Math.min(Math.max(k < 0 ? steps.length - 1 : k, 1), steps.length - 1);
      return k - 0.5 + (value - steps[k - 1]) / (steps[k] - steps[k - 1]);
    }
    // Return the ticks of an axis: round numbers if the values are evenly spaced (linearly, or logarithmically over at
    // least a decade), otherwise some of the values. The tolerance is larger for many values, because these may be a
    // selection from a finer grid, each off by up to half a step of that grid.
    function ticks(steps, most) {
      const last = steps.length - 1, span = Math.abs(steps[last] - steps[0]), slack = last > 20 ? 0.6 : 0.01;
      const low = Math.min(steps[0], steps[last]), number = typeof steps[0] === "number";
      const even = (scale) => {
        const first = scale(steps[0]), step = (scale(steps[last]) - first) / last;
        return steps.every((value, k) => Math.abs(scale(value) - first - k * step) <= slack * Math.abs(step));
      };
      if (number && low > 0 && span >= 9 * low && even(Math.log)) {
        const decades = Array.from({ length: 700 }, (_, k) => [1, 2, 5].map((n) => Number(`${n}e${k - 350}`))).flat();
        const round = decades.filter((value) => value >= low * 0.999 && value <= (low + span) * 1.001), tens = round.filter((_, k) => decades.indexOf(round[k]) % 3 === 0);
        const chosen = round.length <= most ? round : tens.filter((_, k) => k % Math.ceil(tens.length / most) === 0);
        return chosen.map((value) => [place(steps, value), spell(value)]);
      }
      if (!number || !even(Number))
        return [...new Set(Array.from({ length: most }, (_, k) => Math.round(k * last / (most - 1))))].map((k) => [k + 0.5, spell(steps[k], 4).slice(0, 12)]);
      const size = 10 ** Math.floor(Math.log10(span / most)), unit = [1, 2, 5, 10].find((n) => n * size >= span / most) * size;
      const first = Math.ceil(low / unit - 1e-9), count = Math.floor((low + span) / unit + 1e-9) - first;
      return Array.from({ length: count + 1 }, (_, k) => unit * (first + k)).map((value) => [place(steps, value), spell(value, 12)]);
    }
    function draw() {
      const scale = window.devicePixelRatio || 1, style = getComputedStyle(canvas);
      const wide = canvas.clientWidth, high = Math.round(0.66 * wide);
      canvas.width = wide * scale; canvas.height = high * scale;
      const { left, top } = box, across = wide - left - box.right, up = high - top - box.bottom;
      pen.setTransform(scale, 0, 0, scale, 0, 0);
      pen.imageSmoothingEnabled = false;
      pen.drawImage(small, left, top, across, up);
      const line = (x0, y0, x1, y1) => { pen.beginPath(); pen.moveTo(x0, y0); pen.lineTo(x1, y1); pen.stroke(); };
      const write = (text, x, y, align, most) => { pen.textAlign = align; pen.fillText(text, x, y, most); };
      pen.strokeStyle = pen.fillStyle = style.color;
      pen.font = "12px system-ui, sans-serif"; pen.textBaseline = "middle"; pen.lineWidth = 1;
      pen.strokeRect(left, top, across, up);
      for (const [share, text] of ticks(data.x.values, Math.max(3, Math.floor(across / 70)))) {
        const x = left + share / columns * across;
        line(x, top + up, x, top + up + 5); write(text, x, top + up + 14, "center", across / 5);
      }
      for (const [share, text] of ticks(data.y.values, Math.max(3, Math.floor(up / 50)))) {
        const y = top + up - share / rows * up;
        line(left - 5, y, left, y); write(text, left - 8, y, "right", left - 28);
      }
      const named = (axis) => axis.unit ? `${axis.name} in ${axis.unit}` : axis.name;
      write(named(data.x), left + across / 2, high - 8, "center", across);
      pen.save(); pen.translate(9, top + up / 2); pen.rotate(-Math.PI / 2); write(named(data.y), 0, 0, "center", up); pen.restore();
      // Draw the color bar, with the values at its ends and in its middle.
      const bar = left + across + 12;
      for (let k = 0; k < up; k++) { pen.fillStyle = `rgb(${color(data.truth ? +(k < up / 2) : 1 - k / up)})`; pen.fillRect(bar, top + k, 12, 1.5); }
      // Draw an arrow at each end of the color bar beyond which values lie; these values have the color of that end.
      for (const [side, level, peak] of [["min", top + up, top + up + 10], ["max", top, top - 10]]) if ([side, "both"].includes(data.extend)) {
        pen.fillStyle = `rgb(${color(side === "max" ? 1 : 0)})`;
        pen.beginPath(); pen.moveTo(bar, level); pen.lineTo(bar + 12, level); pen.lineTo(bar + 6, peak); pen.closePath(); pen.fill();
      }
      pen.fillStyle = style.color;
      const valueAt = (share) => logarithmic ? data.low * (data.high / data.low) ** share : data.low + share * (data.high - data.low);
      // Use the fewest digits with which each printed value is within 1 % of the range of the color bar.
      const digits = [3, 4, 5, 6, 7].find((most) => [0, 0.5, 1].every((share) => Math.abs(spell(valueAt(share), most) - valueAt(share)) <= 0.01 * (data.high - data.low)));
      for (const share of data.truth ? [0.25, 0.75] : [0, 0.5, 1])
        write(data.truth ? (share > 0.5 ? "yes" : "no") : spell(valueAt(share), digits), bar + 16, top + Math.min(Math.max(up * (1 - share), 6), up - 6), "left", box.right - 30);
      pen.save(); pen.beginPath(); pen.rect(left, top, across, up); pen.clip();
      for (const [name, rings] of Object.entries(data.edges[offset() / rows / columns])) for (const ring of rings) {
        pen.setLineDash(name === "passive" ? [7, 4] : []);
        pen.beginPath();
        const points = decode(ring);
        for (let k = 0; k < points.length; k += 2)
          pen.lineTo(left + place(data.x.values, points[k]) / columns * across, top + up - place(data.y.values, points[k + 1]) / rows * up);
        pen.closePath();
        // Draw black on white, which is visible on every color.
        for (const [width, ink] of [[4, "#ffffff"], [2, "#000000"]]) { pen.lineWidth = width; pen.strokeStyle = ink; pen.stroke(); }
      }
      pen.restore();
      pen.setLineDash([]);
      for (const [width, ink] of [[4, "#ffffff"], [2, "#000000"]]) {
        pen.lineWidth = width; pen.strokeStyle = ink;
        pen.strokeRect(left + (at.column + 0.5) / columns * across - 4, top + up - (at.row + 0.5) / rows * up - 4, 8, 8);
      }
    }
    function tell() {
      draw();
      const value = values[offset() + at.row * columns + at.column];
      const words = Number.isNaN(value) ? "no result" : !Number.isFinite(value) ? "infinite" : data.truth ? (value ? data.name : `not ${data.name}`) : spell(value);
      const known = (axis, k) => `${axis.name} = ${spell(axis.values[k])} ${axis.unit}`.trim();
      readout.textContent = `${known(data.x, at.column)}, ${known(data.y, at.row)}: ${words} ${data.truth ? "" : data.unit}`;
    }
    sliders.forEach((slider) => slider.addEventListener("input", paint));
    canvas.addEventListener("pointermove", (event) => {
      const x = event.offsetX - box.left, y = event.offsetY - box.top;
      const across = canvas.clientWidth - box.left - box.right, up = canvas.clientHeight - box.top - box.bottom;
      at.column = Math.min(columns - 1, Math.max(0, Math.floor(x / across * columns)));
      at.row = Math.min(rows - 1, Math.max(0, rows - 1 - Math.floor(y / up * rows)));
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
    new ResizeObserver(draw).observe(block);
    window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
    paint();
  }
  document.querySelectorAll(".slices").forEach(show);
})();
