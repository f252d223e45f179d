"use strict";
// Shows two pictures of a held-out view with a slider between them, their difference, and the view's scores.

{
  const data = document.getElementById("compared");
  if (data) show(JSON.parse(data.textContent));
}

function show({ runs, views, ramp, limit }) {
  const byId = (name) => document.getElementById(name);
  const [view, left, right, cut, stage] = ["view", "left", "right", "cut", "stage"].map(byId);
  const sources = ["photo", ...runs];
  const colors = Uint8Array.from(atob(ramp), (letter) => letter.charCodeAt(0));
  let latestDraw = 0;

  // Fills a menu with names, and draws again when another one is chosen.
  const fill = (select, names, chosen) => {
    select.append(...names.map((name, place) => new Option(name, place, false, place === chosen)));
    select.addEventListener("change", draw);
  };

  // Shows what the menus say.
  async function draw() {
    const thisDraw = ++latestDraw;
    const shown = views[view.value];
    const [first, second] = [left, right].map((select) => ({ name: sources[select.value], address: shown.pictures[select.value] }));
    byId("over").src = first.address;
    byId("under").src = second.address;
    byId("over").alt = `${shown.name}, ${first.name}`;
    byId("under").alt = `${shown.name}, ${second.name}`;
    byId("left-name").textContent = `left: ${first.name}`;
    byId("right-name").textContent = `right: ${second.name}`;
    writeScores(shown.scores);
    // Decoding fails if another picture was chosen meanwhile.
    await Promise.all([byId("over").decode(), byId("under").decode()]).catch(() => {});
    if (thisDraw !== latestDraw) return;
    document.querySelector(".pair").style.setProperty("--ratio", byId("over").naturalWidth / byId("over").naturalHeight);
    drawDifference(byId("over"), byId("under"));
  }

  // Returns the RGBA bytes of an image.
  function pixels(image) {
    const canvas = new OffscreenCanvas(image.naturalWidth, image.naturalHeight);
    const context = canvas.getContext("2d");
    context.drawImage(image, 0, 0);
    return context.getImageData(0, 0, canvas.width, canvas.height).data;
  }

  // Draws the mean absolute difference of the three channels of each pixel, in the colours of `ramp`.
  function drawDifference(first, second) {
    const a = pixels(first), b = pixels(second), canvas = byId("difference");
    canvas.width = first.naturalWidth;
    canvas.height = first.naturalHeight;
    const context = canvas.getContext("2d"), picture = context.createImageData(canvas.width, canvas.height);
    let sum = 0;
    for (let at = 0; at < a.length; at += 4) {
      const delta = (Math.abs(a[at] - b[at]) + Math.abs(a[at + 1] - b[at + 1]) + Math.abs(a[at + 2] - b[at + 2])) / 3;
      sum += delta;
      const color = 3 * Math.min(255, Math.round(delta / limit));
      picture.data.set([colors[color], colors[color + 1], colors[color + 2], 255], at);
    }
    context.putImageData(picture, 0, 0);
    const mean = ((4 * sum) / a.length).toFixed(2);
    byId("difference-name").textContent =
      `difference of left and right: black is none, the brightest ${Math.round(255 * limit)} of 255 levels or more; the mean is ${mean} levels`;
  }

  // Writes the table of scores, without columns that no run has.
  function writeScores(scores) {
    const columns = ["PSNR (dB)", "SSIM", "LPIPS"].filter((_, place) => scores.some((score) => score[place] !== null));
    const cell = (kind, text) => Object.assign(document.createElement(kind), { textContent: text });
    const row = (...cells) => {
      const element = document.createElement("tr");
      element.append(...cells);
      return element;
    };
    const head = document.createElement("thead"), body = document.createElement("tbody");
    head.append(row(cell("th", "run"), ...columns.map((name) => cell("th", name))));
    body.append(
      ...runs.map((name, run) =>
        row(cell("th", name), ...columns.map((_, place) => cell("td", formatScore(scores[run][place], place)))),
      ),
    );
    const table = byId("scores");
    table.tHead?.remove();
    table.tBodies[0]?.remove();
    table.append(head, body);
  }

  function formatScore(score, place) {
    return score === null ? "-" : score.toFixed(place ? 4 : 2);
  }

  const moveSlider = () => stage.style.setProperty("--cut", `${cut.value}%`);
  const drag = (event) => {
    const box = stage.getBoundingClientRect();
    cut.value = (100 * (event.clientX - box.left)) / box.width;
    moveSlider();
  };
  cut.addEventListener("input", moveSlider);
  stage.addEventListener("pointerdown", (event) => {
    stage.setPointerCapture(event.pointerId);
    drag(event);
  });
  stage.addEventListener("pointermove", (event) => {
    if (stage.hasPointerCapture(event.pointerId)) drag(event);
  });

  fill(view, views.map(({ name }) => name), 0);
  fill(left, sources, 0);
  fill(right, sources, 1);
  draw();
}
