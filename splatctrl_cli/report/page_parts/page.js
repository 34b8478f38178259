"use strict";
// The value of each curve where the pointer is; a click moves the arm of the section's scene there.

function sceneOf(svg) { return svg.closest("section")?.querySelector(".space"); }

function watchTimeline(svg) {
  const d = svg.dataset, words = svg.parentElement.querySelector(".hover");
  const cursor = document.createElementNS("http://www.w3.org/2000/svg", "path");
  cursor.classList.add("cursor");
  svg.append(cursor);
  const curves = [...svg.querySelectorAll("polyline")].map((line) => ({
    name: line.dataset.name,
    points: line.getAttribute("points").split(" ").map((pair) => pair.split(",").map(Number)),
  }));
  const timeAt = (event) => {
    const box = svg.getBoundingClientRect(), x = ((event.clientX - box.left) * svg.viewBox.baseVal.width) / box.width;
    const inside = Math.min(Math.max(x, +d.left), +d.right);
    return {x: inside, time: +d.start + ((+d.end - +d.start) * (inside - +d.left)) / (+d.right - +d.left)};
  };
  svg.addEventListener("pointermove", (event) => {
    const {x, time} = timeAt(event), said = {};
    cursor.setAttribute("d", `M${x} ${d.top}V${svg.viewBox.baseVal.height}`);
    for (const {name, points} of curves) {
      if (x < points[0][0] - 2 || x > points.at(-1)[0] + 2) continue;
      const nearest = points.reduce((a, b) => (Math.abs(b[0] - x) < Math.abs(a[0] - x) ? b : a));
      const centimetres = +d.high - ((nearest[1] - +d.top) / (+d.bottom - +d.top)) * (+d.high - +d.low);
      said[name] = `${name} ${(10 * centimetres).toFixed(1)} mm`;
    }
    words.textContent = [`${time.toFixed(2)} s`, ...Object.values(said)].join("; ");
  });
  svg.addEventListener("click", (event) => {
    const viewer = sceneOf(svg)?.viewer;
    if (viewer && viewer === opened) viewer.show(viewer.nearest(timeAt(event).time));
  });
}

document.querySelectorAll(".timeline").forEach(watchTimeline);
document.querySelectorAll("button.open").forEach((button) => {
  button.onclick = () => openScene(button.parentElement.querySelector(".space"));
});
document.querySelectorAll("figure:not(.pair)").forEach((figure) => {
  figure.onclick = () => figure.classList.toggle("wide");
});
[...document.querySelectorAll(".space[data-open]")].slice(0, 1).forEach((first) => openScene(first));
