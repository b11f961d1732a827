"use strict";
(function () {
  const root = document.documentElement;
  let drawn = 0, errors = 0;
  const count = () => { root.dataset.plots = String(drawn); root.dataset.errors = String(errors); };
  window.addEventListener("error", () => { errors += 1; count(); });
  count();

  const data = JSON.parse(document.getElementById("report-data").textContent);
  const css = getComputedStyle(root);
  const colour = name => css.getPropertyValue(name).trim();
  // By the dash as well as by the colour: the page may be printed in grey.
  const look = {
    measured: { stroke: colour("--measured"), width: 3 },
    nominal: { stroke: colour("--nominal"), width: 1.8, dash: [2, 3] },
    calibrated: { stroke: colour("--calibrated"), width: 1.6, dash: [9, 3] },
    improved: { stroke: colour("--improved-line"), width: 1.4 },
    input: { stroke: "#5f6b7a", width: 1.3 },
    noise: { stroke: "#a4acb7", width: 1.3, dash: [5, 4] },
    reference: { stroke: colour("--measured"), width: 1.3, dash: [6, 4], paths: uPlot.paths.stepped({ align: 1 }) },
    command: { stroke: colour("--improved-line"), width: 1.4, paths: uPlot.paths.stepped({ align: 1 }) },
    limit: { stroke: colour("--bad"), width: 1.1, dash: [6, 5] },
    envelope: { stroke: "#8fc3e2", width: 1 },
  };
  const sups = { "-": "⁻", 0: "⁰", 1: "¹", 2: "²", 3: "³", 4: "⁴", 5: "⁵", 6: "⁶", 7: "⁷", 8: "⁸", 9: "⁹" };
  const power = e => "10" + String(e).replace(/./g, c => sups[c]);
  const minus = s => s.replace("-", "−");
  // Three significant digits, as in the tables.
  const number = v => {
    if (v == null) return "";
    if (v === 0) return "0";
    const [m, e] = v.toExponential(2).split("e");
    const n = Number(e);
    if (n < -4 || n > 5) return minus(m) + " × " + power(n);
    return minus(v.toFixed(Math.max(0, 2 - n)));
  };
  const ticks = (u, splits, axis, space, step) => {
    const largest = Math.max(...splits.map(v => Math.abs(v)));
    const small = largest > 0 && (largest < 1e-3 || largest >= 1e6);
    const e = small ? Math.floor(Math.log10(largest)) : 0;
    const unit = step / 10 ** e;
    let decimals = 0;
    while (decimals < 8 && Math.abs(unit * 10 ** decimals - Math.round(unit * 10 ** decimals)) > 1e-6 * unit * 10 ** decimals) decimals += 1;
    return splits.map(v => v === 0 ? "0" : minus((v / 10 ** e).toFixed(decimals)) + (e ? "·" + power(e) : ""));
  };
  const decades = (u, splits) => splits.map(v => {
    if (v == null) return "";
    const e = Math.round(Math.log10(v));
    if (Math.abs(v / 10 ** e - 1) > 1e-6) return "";
    return e >= -2 && e <= 3 ? String(10 ** e).slice(0, 6) : power(e);
  });

  // Behind the curves: where the mechanism acts, the noise band, the start of the held-out part.
  const behind = plot => u => {
    const { ctx, bbox } = u;
    const clamp = (v, a, b) => Math.min(b, Math.max(a, v));
    ctx.save();
    ctx.fillStyle = "#fbecc8";
    for (const [from, to] of plot.bands) {
      const a = clamp(u.valToPos(from, "x", true), bbox.left, bbox.left + bbox.width);
      const b = clamp(u.valToPos(to, "x", true), bbox.left, bbox.left + bbox.width);
      if (b > a) ctx.fillRect(a, bbox.top, Math.max(1, b - a), bbox.height);
    }
    if (plot.sigma != null) {
      const a = clamp(u.valToPos(2 * plot.sigma, "y", true), bbox.top, bbox.top + bbox.height);
      const b = clamp(u.valToPos(-2 * plot.sigma, "y", true), bbox.top, bbox.top + bbox.height);
      ctx.fillStyle = "rgba(120, 130, 145, .22)";
      ctx.fillRect(bbox.left, a, bbox.width, Math.max(1, b - a));
    }
    if (plot.split != null) {
      const x = u.valToPos(plot.split, "x", true);
      if (x > bbox.left && x < bbox.left + bbox.width) {
        ctx.strokeStyle = "#6b7684"; ctx.setLineDash([6, 5]); ctx.lineWidth = devicePixelRatio || 1;
        ctx.beginPath(); ctx.moveTo(x, bbox.top); ctx.lineTo(x, bbox.top + bbox.height); ctx.stroke();
      }
    }
    ctx.restore();
  };

  const axisStyle = { stroke: "#4a5462", font: "12px system-ui, sans-serif", labelFont: "12.5px system-ui, sans-serif",
    grid: { stroke: "#e7eaee", width: 1 }, ticks: { stroke: "#c5ccd4", width: 1, size: 5 } };

  function draw(host, plot) {
    const log = plot.kind === "spectrum";
    const values = log ? decades : ticks;
    const narrow = () => host.clientWidth < 480;
    const options = {
      width: Math.max(220, host.clientWidth), height: plot.height,
      padding: [10, 14, 0, 0],
      cursor: { sync: { key: plot.sync, scales: ["x", null], setSeries: false }, drag: { x: true, y: false }, points: { size: 7 } },
      legend: { live: true, markers: { dash: (u, i) => u.series[i].dash ? (u.series[i].dash[0] < 4 ? "dotted" : "dashed") : "solid" } },
      scales: { x: log ? { time: false, distr: 3 } : { time: false }, y: log ? { distr: 3 } : {} },
      axes: [
        Object.assign({}, axisStyle, { label: plot.x, labelSize: 22, size: 30, values, space: log ? 40 : (narrow() ? 50 : 70) }),
        Object.assign({}, axisStyle, { size: 56, values, space: log ? 26 : plot.height < 200 ? 24 : 34 }),
      ],
      series: [
        { label: log ? "f in Hz" : "t in s", value: (u, v) => number(v) },
        ...plot.series.map(s => Object.assign({ label: s.label, points: { show: false }, value: (u, v) => number(v), spanGaps: false }, look[s.role])),
      ],
      bands: (plot.fills || []).map(([upper, lower]) => ({ series: [upper + 1, lower + 1], fill: "rgba(26, 143, 209, .18)" })),
      hooks: {
        drawClear: [behind(plot)],
        setSeries: [(u, i) => {
          const th = u.root.querySelectorAll(".u-legend .u-series th")[i];
          if (i > 0 && th) th.setAttribute("aria-pressed", String(u.series[i].show));
        }],
      },
    };
    if (log) {
      // A minimum that is one numerical zero must not squash the rest.
      const top = Math.max(...plot.series.map(s => s.data.reduce((a, v) => v > a ? v : a, 0)));
      const low = Math.min(...plot.series.map(s => s.data.reduce((a, v) => v != null && v < a ? v : a, Infinity)));
      const range = [10 ** Math.floor(Math.log10(Math.max(low, top * 1e-7))), 10 ** Math.ceil(Math.log10(top))];
      if (range[1] > range[0]) options.scales.y.range = () => range;
    }
    const u = new uPlot(options, [data.axes[plot.axis], ...plot.series.map(s => s.data)], host);
    // The figure says what is drawn; the legend is a row of switches, by keyboard as well.
    u.root.querySelector(".u-wrap").setAttribute("aria-hidden", "true");
    const legend = u.root.querySelector(".u-legend");
    legend.setAttribute("role", "group"); legend.setAttribute("aria-label", "Curves shown");
    legend.querySelectorAll(".u-series th").forEach((th, i) => {
      if (i === 0) return;
      th.tabIndex = 0; th.setAttribute("role", "button"); th.setAttribute("aria-pressed", "true");
      th.addEventListener("keydown", e => { if (e.key === "Enter" || e.key === " ") { e.preventDefault(); th.click(); } });
    });
    return u;
  }

  const plots = [];
  for (const host of document.querySelectorAll("[data-plot]")) {
    try {
      const plot = data.plots[Number(host.dataset.plot)];
      plots.push({ host, height: plot.height, u: draw(host, plot) });
      drawn += 1;
    } catch (error) {
      errors += 1;
      root.dataset.error = String(error);
    }
  }
  const fit = width => { for (const p of plots) { const w = Math.max(220, width || p.host.clientWidth); if (w !== p.u.width) p.u.setSize({ width: w, height: p.height }); } };
  let pending = 0;
  window.addEventListener("resize", () => { cancelAnimationFrame(pending); pending = requestAnimationFrame(() => fit()); });
  // Print: the canvases take the paper's width; in a two-column place, half of it.
  window.addEventListener("beforeprint", () => { for (const p of plots) p.u.setSize({ width: p.host.closest(".pair") ? 320 : 680, height: p.height }); });
  window.addEventListener("afterprint", () => fit());
  count();
})();
