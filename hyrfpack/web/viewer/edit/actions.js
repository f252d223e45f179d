// The actions of an edit, in the vocabulary of `hyrfpack edit`. An action is {option, value} with the name of the
// option, without dashes, and its value: a number, a word, or several numbers. A crop box also has `isInverted`; a
// seventh number turns it, in degrees, about its centre and the up direction.

import { frameAxes, rotateBack, rotateBy, rowsOf, transpose } from "../../hyrf/rotation.js";
import { add, cross, dot, mul, sub, unit } from "../../hyrf/vectors.js";

const POSITION_DIGITS_IN_UNIT_SCENE = 4; // behind the decimal point
const DIRECTION_DIGITS = 6;
const MIN_SCENE_SIZE = 1e-30; // this limit and the next one are those of `hyrfpack edit`
const MAX_WORLD_COORDINATE = 1e30;
const AXIS_VECTORS = { x: [1, 0, 0], y: [0, 1, 0], z: [0, 0, 1] };
// An action takes the place of an earlier one of the same option, unless one of these lies between. A box is turned
// about the direction that was stated before it.
const SEPARATORS = {
  "crop-box": ["scale", "upright"],
  "max-scale": ["scale"],
  "min-opacity": [],
  up: ["upright", "crop-box"],
};

// Returns the index of the action that another one of the option would replace, or -1.
export function findActive(actions, option) {
  const separators = SEPARATORS[option] ?? actions.map((action) => action.option);
  const lastSeparator = actions.findLastIndex((action) => separators.includes(action.option));
  const index = actions.findLastIndex((action) => action.option === option);
  return index > lastSeparator ? index : -1;
}

// Returns the actions with another one, which replaces the active one of its option.
export function putAction(actions, action) {
  const active = findActive(actions, action.option);
  return active < 0 ? [...actions, action] : actions.with(active, action);
}

// Returns the actions without the active one of an option.
export function dropAction(actions, option) {
  const active = findActive(actions, option);
  return actions.filter((_, index) => index !== active);
}

// Returns where actions move a scene, p' = factor rows p in world units, and the up direction after them.
export function placementAfter(actions, scene) {
  let factor = 1, rows = [AXIS_VECTORS.x, AXIS_VECTORS.y, AXIS_VECTORS.z], up = unit(scene.up);
  for (const { option, value } of actions) {
    if (option === "scale") factor *= value;
    if (option === "up") up = unit(value);
    if (option === "upright") {
      const turn = uprightRows(up, AXIS_VECTORS[value]);
      const columns = transpose(rows).map((column) => rotateBy(turn, column));
      rows = transpose(columns);
      up = rotateBy(turn, up);
    }
  }
  return { factor, rows, up };
}

// Returns whether `hyrfpack edit` accepts where actions move a scene, as move_frame in hyrfpack/edit/transform.py.
export function isStorable(actions, scene) {
  const { factor, rows } = placementAfter(actions, scene), size = factor * scene.unit;
  const center = mul(rotateBy(rows, scene.center), factor), reach = Math.max(size, ...center.map(Math.abs));
  return size >= MIN_SCENE_SIZE && reach <= MAX_WORLD_COORDINATE;
}

// Returns the rows of the rotation that maps `up` to `target`, as upright_rotation in hyrfpack/splats/placement.py: if
// they point in opposite directions, half a turn about x comes first.
function uprightRows(up, target) {
  if (dot(up, target) >= 0) return shortestRows(up, target);
  const [a, b, c] = transpose(shortestRows([up[0], -up[1], -up[2]], target));
  return transpose([a, mul(b, -1), mul(c, -1)]);
}

// Returns the rows of the shortest rotation between unit vectors whose dot product is not negative.
function shortestRows(from, to) {
  const [x, y, z] = cross(from, to), cosine = dot(from, to), k = 1 / (1 + cosine);
  return [
    [cosine + k * x * x, k * x * y - z, k * x * z + y],
    [k * x * y + z, cosine + k * y * y, k * y * z - x],
    [k * x * z - y, k * y * z + x, cosine + k * z * z],
  ];
}

// Returns 3 x 4 numbers that map positions in the page's coordinates to world units after a placement.
export function worldFromPage({ factor, rows }, scene) {
  const columns = transpose(frameAxes(scene)).map((axis) => mul(rotateBy(rows, axis), factor * scene.unit));
  const shift = mul(rotateBy(rows, scene.center), factor);
  return transpose(columns).map((row, axis) => [...row, shift[axis]]);
}

// Returns the selections of Gaussians (see selection.js) that actions keep.
export function selectionsOf(actions, scene) {
  return actions.flatMap(({ option, value, isInverted = false }, index) => {
    const placement = placementAfter(actions.slice(0, index), scene);
    if (option === "min-opacity") return [{ minOpacity: value }];
    if (option === "max-scale") return [{ maxLength: value / (placement.factor * scene.unit) }];
    if (option !== "crop-box") return [];
    const low = value.slice(0, 3), high = value.slice(3, 6), rows = worldFromPage(placement, scene);
    const turned = value[6] ? turnedBack(rows, boxTurn(value, placement.up), middleOf(low, high)) : rows;
    return [{ rows: turned, low, high, isInverted }];
  });
}

// Returns the rows of the rotation that turns a crop box, of `value`, about its centre.
export function boxTurn([, , , , , , degrees = 0], up) {
  const half = (degrees * Math.PI) / 360;
  return rowsOf([Math.cos(half), ...mul(up, Math.sin(half))]);
}

export const middleOf = (low, high) => mul(add(low, high), 0.5);

// Returns 3 x 4 numbers that map positions as `rows` do, and then turn them back about a point.
function turnedBack(rows, turn, middle) {
  const columns = [0, 1, 2, 3].map((k) => rows.map((row) => row[k]));
  const [a, b, c] = columns.slice(0, 3).map((column) => rotateBack(turn, column));
  const shift = add(rotateBack(turn, sub(columns[3], middle)), middle);
  return [0, 1, 2].map((k) => [a[k], b[k], c[k], shift[k]]);
}

// Rounds a position or a length to a step that is invisible in a scene of a size, both in world units.
export function roundLength(value, size) {
  const digits = Math.min(100, Math.max(0, POSITION_DIGITS_IN_UNIT_SCENE - Math.floor(Math.log10(size))));
  return Number(value.toFixed(digits)) + 0; // turns -0 into 0
}

// Returns the action that states an up direction, a unit vector.
export const statedUp = (up) => ({ option: "up", value: up.map((part) => Number(part.toFixed(DIRECTION_DIGITS)) + 0) });

// Returns the command that applies actions to a file, for POSIX shells and PowerShell; for the former alone if the
// file's name has both an apostrophe and a character that is special in double quotes.
export function commandText(actions, file) {
  const stem = file.split(/[\\/]/).pop().replace(/\.hyrf$/i, "") || "scene";
  const options = actions.map(({ option, value, isInverted }) => {
    return `--${option}=${[value].flat().join()}${isInverted ? " --invert" : ""}`;
  });
  return ["hyrfpack edit", shellWord(file), "-o", shellWord(`${stem}-edited.hyrf`), ...options].join(" ");
}

// Returns a path as one word of a shell, in double quotes if it has an apostrophe and nothing that is special in them.
// To PowerShell, typographic quotes are quotes, too.
function shellWord(path) {
  const word = path.startsWith("-") ? `./${path}` : path;
  if (/^[\p{L}\p{N}_.\/:+-]+$/u.test(word)) return word;
  return /["“-„$`!]|\\\W|^[^'’]*$/.test(word) ? `'${word.replaceAll("'", "'\\''")}'` : `"${word}"`;
}
