// What keeps a reader out: the faults of the page `doc`, as sentences.
function audit(doc) {
  const view = doc.defaultView, width = doc.documentElement.clientWidth, faults = [];
  const all = selector => [...doc.querySelectorAll(selector)];
  const called = e => `<${e.localName}${e.id ? " #" + e.id : ""}> ${e.textContent.trim().replace(/\s+/g, " ").slice(0, 40)}`;
  const require = (holds, fault) => { if (!holds) faults.push(fault); };

  // Only boxes made for it scroll sideways, and the keyboard reaches them by name.
  require(doc.documentElement.scrollWidth <= width, `the page is ${doc.documentElement.scrollWidth} px wide, the window ${width}`);
  for (const e of all("body *")) {
    if (!["auto", "scroll"].includes(view.getComputedStyle(e).overflowX) || e.scrollWidth <= e.clientWidth) continue;
    require(e.tabIndex === 0 && e.getAttribute("role") && (e.getAttribute("aria-label") || e.getAttribute("aria-labelledby")), `scrolls, but not by keyboard or without a name: ${called(e)}`);
  }

  require(doc.documentElement.lang === "en", "no language");
  for (const part of ["main", "header", "footer", "h1", "nav[aria-label]"]) require(all(part).length === 1, `${all(part).length} of ${part}`);
  const first = all("a[href], button, [tabindex='0']")[0];
  require(first && first.matches(".skip") && doc.querySelector(first.getAttribute("href")), "the first stop of the keyboard does not skip to the content");
  let level = 0;
  for (const h of all("h1, h2, h3, h4, h5, h6")) {
    require(Number(h.localName[1]) <= level + 1, `a heading is skipped before ${called(h)}`);
    level = Number(h.localName[1]);
  }
  for (const e of all("[id]")) require(all(`[id="${view.CSS.escape(e.id)}"]`).length === 1, `twice: ${called(e)}`);
  for (const e of all("[aria-labelledby]")) require(doc.getElementById(e.getAttribute("aria-labelledby")), `named by nothing: ${called(e)}`);
  for (const e of all("a[href^='#']")) require(doc.getElementById(e.getAttribute("href").slice(1)), `leads nowhere: ${called(e)}`);

  // A legend is a row of switches, no table.
  for (const e of all("table:not([role])")) {
    require(e.caption && e.caption.textContent.trim(), `no caption: ${called(e)}`);
    for (const th of e.querySelectorAll("th")) require(th.scope && th.textContent.trim(), `no scope or empty: ${called(th)} in ${called(e)}`);
  }
  for (const e of all("svg, .share-bar")) require(e.closest("[aria-hidden='true']") || (e.getAttribute("role") === "img" && e.getAttribute("aria-label")), `a drawing without words: ${called(e)}`);
  for (const e of all("canvas")) require(e.closest("[aria-hidden='true']") && e.closest("figure[aria-label]"), `a plot without words: ${called(e)}`);
  for (const e of all("[role='button']")) require(e.getAttribute("aria-pressed") && e.tabIndex === 0, `no switch: ${called(e)}`);

  // WCAG 2.2, 1.4.3: the contrast of text is at least 4.5.
  const parts = colour => colour.match(/[\d.]+/g).map(Number);
  const luminance = rgb => {
    const [r, g, b] = rgb.map(v => v / 255).map(v => v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4);
    return 0.2126 * r + 0.7152 * g + 0.0722 * b;
  };
  for (const e of all("body *:not(script)")) {
    if (!e.getClientRects().length || ![...e.childNodes].some(n => n.nodeType === 3 && n.data.trim())) continue;
    let ground = [255, 255, 255];
    for (let p = e; p; p = p.parentElement) {
      const [r, g, b, a = 1] = parts(view.getComputedStyle(p).backgroundColor);
      if (a === 1) { ground = [r, g, b]; break; }
    }
    const style = view.getComputedStyle(e);
    const [low, high] = [luminance(parts(e.closest("svg") ? style.fill : style.color).slice(0, 3)), luminance(ground)].sort((a, b) => a - b);
    const contrast = (high + 0.05) / (low + 0.05);
    require(contrast >= 4.5, `contrast ${contrast.toFixed(2)}: ${called(e)}`);
  }
  return faults;
}
