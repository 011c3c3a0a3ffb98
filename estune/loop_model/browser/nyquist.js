// Loop gain in the complex plane, with the unit circle and the disc that a sensitivity limit forbids.

import { colour } from "./charts.js";

const LEFT = -2.6, RIGHT = 1.2; // of the real part; the loop gain beyond is of low frequency

export class Nyquist {
  constructor(figure, height) {
    this.canvas = document.createElement("canvas");
    figure.append(this.canvas);
    figure.setAttribute("role", "img");
    figure.setAttribute("aria-label", "Loop gain in the complex plane, with the disc that the limit of Ms forbids");
    this.figure = figure;
    this.height = height;
    new ResizeObserver(([{ contentRect }]) => { // asked for at each drawing, the width would lay out the page
      this.width = contentRect.width;
      this.draw();
    }).observe(figure);
  }

  // Curves are {re, im, colour, width, dash}; drawn in their order.
  show(curves, Ms) {
    this.curves = curves;
    this.Ms = Ms;
    this.draw();
  }

  draw() {
    if (!this.curves) return;
    const { canvas, height } = this, width = Math.max(200, this.width ?? this.figure.clientWidth), ratio = devicePixelRatio;
    const g = canvas.getContext("2d"), size = `${width},${height},${ratio}`;
    if (size !== this.size) {
      this.size = size;
      canvas.style.cssText = `width: ${width}px; height: ${height}px`;
      [canvas.width, canvas.height] = [width * ratio, height * ratio];
    }
    g.setTransform(ratio, 0, 0, ratio, 0, 0);
    g.clearRect(0, 0, width, height);
    const scale = Math.min(width / (RIGHT - LEFT), height / 3.4);
    const px = (re) => width / 2 + (re - (LEFT + RIGHT) / 2) * scale, py = (im) => height * 0.42 - im * scale;
    const line = (points, style, w, dash = []) => {
      g.beginPath();
      points.forEach(([x, y], n) => (n ? g.lineTo(x, y) : g.moveTo(x, y)));
      g.strokeStyle = style;
      g.lineWidth = w;
      g.setLineDash(dash);
      g.stroke();
    };
    line([[0, py(0)], [width, py(0)]], colour("rule"), 1);
    line([[px(0), 0], [px(0), height]], colour("rule"), 1);
    const circle = (re, radius) => { g.beginPath(); g.arc(px(re), py(0), radius * scale, 0, 2 * Math.PI); };
    g.setLineDash([]);
    circle(0, 1);
    g.strokeStyle = colour("grey");
    g.lineWidth = 1;
    g.stroke();
    circle(-1, 1 / this.Ms);
    g.fillStyle = colour("band");
    g.fill();
    for (const { re, im, colour: name, width: w, dash, faint } of this.curves) {
      const points = [];
      for (let n = 0; n < re.length; n++) if (Math.hypot(re[n], im[n]) < 6) points.push([px(re[n]), py(im[n])]);
      g.globalAlpha = faint ? 0.25 : 1;
      line(points, colour(name), w, dash);
      g.globalAlpha = 1;
    }
    g.textAlign = "left";
    g.font = "12px system-ui, sans-serif";
    g.fillStyle = colour("ink");
    g.fillText("Im L", px(0) + 4, 12);
    g.textAlign = "right";
    g.fillText("Re L", width - 2, py(0) - 4);
    g.textAlign = "center";
    g.fillText("\u22121", px(-1), py(0) + 14);
  }
}
