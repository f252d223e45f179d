// Formats cameras for links and parses them again: `node links.mjs CAMERAS.json` with a list of {rows, eye, fy, unit,
// center, rotation}. Prints, for each camera, its text, the parsed camera, and the expected values, as JSON.

import { readFileSync } from "node:fs";
import { formatCamera, parseCamera } from "../../hyrfpack/web/viewer/address.js";
import { Eye } from "../../hyrfpack/web/viewer/camera.js";

const answers = JSON.parse(readFileSync(process.argv[2], "utf8")).map(({ rows, eye, fy, unit, center, rotation }) => {
  const scene = { center, unit, rotation, up: [0, -1, 0], target: center, cameras: [] };
  const view = { rows, eye, fy, width: 900, height: 700 };
  const mover = new Eye(scene, [view]);
  mover.setView(view);
  const text = formatCamera(mover, scene), { view: parsed, depth } = parseCamera(text, scene);
  const focal = parsed.fy / Math.sqrt(parsed.width * parsed.height);
  const expected = { focal: mover.focal, depth: mover.depth, pace: mover.pace };
  return { text, rows: parsed.rows, eye: parsed.eye, focal, depth, expected };
});
console.log(JSON.stringify(answers));
