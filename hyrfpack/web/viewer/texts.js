// Returns the texts of the shaders and of the worker's script by their names. Pages and the package store them in
// different ways, so each script says how to find them before it draws.

let findText = null;

// Sets the function that returns a text by its name, such as "blend.frag".
export function setTextSource(find) {
  findText = find;
}

// Returns a text by its name.
export const readText = (name) => findText(name);
