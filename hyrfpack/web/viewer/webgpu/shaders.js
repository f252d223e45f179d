// Returns the texts of the shaders in this folder. Pages and the package store them in different ways.

let findText = null;

// Sets the function that returns a text by its name, such as "blend.wgsl".
export function setShaderSource(find) {
  findText = find;
}

// Returns a text by its name.
export const readShader = (name) => findText(name);

// Builds the shader of a pass over the fields from constants, field.wgsl and the pass' own text. Lines that begin with
// EACH are repeated for each of CELLS cells of hidden units.
export function buildFieldShader(name, constants) {
  const lines = Object.entries(constants).map(([key, value]) => `const ${key} = ${value};`);
  const cells = Array.from({ length: parseInt(constants.CELLS) }, (_, cell) => cell);
  const text = `${readShader("field.wgsl")}\n${readShader(name)}`;
  const whole = text.replace(/^EACH (.*)$/gm, (_, line) => cells.map((cell) => line.replaceAll("$", cell)).join("\n"));
  return [...lines, whole].join("\n");
}
