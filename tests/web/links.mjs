// Cameras written as links write them and read again: [{rows, eye, fy, unit, center}] as JSON in a file.

import { readFileSync } from "node:fs";
import { formatCamera, parseCamera } from "../../hyrfpack/web/viewer/address.js";
import { Eye } from "../../hyrfpack/web/viewer/camera.js";

const answers = JSON.parse(readFileSync(process.argv[2], "utf8")).map(({ rows, eye, fy, unit, center }) => {
  const scene = { center, unit, up: [0, -1, 0], target: center, cameras: [] };
  const view = { rows, eye, fy, width: 900, height: 700 };
  const person = new Eye(scene, [view]);
  person.setView(view);
  const text = formatCamera(person, scene), { view: back, depth } = parseCamera(text, scene);
  const focal = back.fy / Math.sqrt(back.width * back.height);
  return { text, rows: back.rows, eye: back.eye, focal, depth, wanted: { focal: person.focal, depth: person.depth, pace: person.pace } };
});
console.log(JSON.stringify(answers));
