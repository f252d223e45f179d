// Writes an edited file as the player does: `node rewrite.mjs MODEL.hyrf ACTIONS.json WRITER TARGET.hyrf`. Prints whether
// all Gaussians are kept, and the command that does the same, as JSON.

import { readFileSync, writeFileSync } from "node:fs";
import { read } from "../../hyrfpack/web/hyrf/index.js";
import { commandText, selectionsOf } from "../../hyrfpack/web/viewer/edit/actions.js";
import { keepsGaussians, rewriteFile, writeKept } from "../../hyrfpack/web/viewer/edit/rewrite.js";
import { modelScene } from "../../hyrfpack/web/viewer/scene.js";
import { measureGaussians, selectGaussians } from "../../hyrfpack/web/viewer/selection.js";

const [path, actionsPath, writer, target] = process.argv.slice(2), bytes = new Uint8Array(readFileSync(path));
const actions = JSON.parse(readFileSync(actionsPath, "utf8")), model = await read(bytes), keeps = keepsGaussians(actions);
const selections = selectionsOf(actions, modelScene(model, "a scene"));
const { kept } = selectGaussians(selections, model.positions, await measureGaussians(bytes));
const rewritten = keeps ? rewriteFile(bytes, actions, writer) : writeKept(bytes, { model, kept }, actions, writer);
writeFileSync(target, await rewritten);
console.log(JSON.stringify({ keeps, command: commandText(actions, path) }));
