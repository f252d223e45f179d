// Applies actions to a file as the player does: `node edits.mjs MODEL.hyrf ACTIONS.json`. Prints the indices of the
// Gaussians that are left, their number after each selection, and the command that does the same, as JSON.

import { readFileSync } from "node:fs";
import { read } from "../../hyrfpack/web/hyrf/index.js";
import { commandText, selectionsOf } from "../../hyrfpack/web/viewer/edit/actions.js";
import { modelScene } from "../../hyrfpack/web/viewer/scene.js";
import { measureGaussians, selectGaussians } from "../../hyrfpack/web/viewer/selection.js";

const [path, actionsPath] = process.argv.slice(2), bytes = new Uint8Array(readFileSync(path));
const actions = JSON.parse(readFileSync(actionsPath, "utf8"));
const model = await read(bytes), scene = modelScene(model, "a scene");
const { kept, counts } = selectGaussians(selectionsOf(actions, scene), model.positions, await measureGaussians(bytes));
const left = [...kept.keys()].filter((index) => kept[index]);
console.log(JSON.stringify({ left, counts, command: commandText(actions, path) }));
