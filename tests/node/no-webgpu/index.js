export const globals = {};

export function create() {
  throw new Error("there is no WebGPU here; give --gpu cpu");
}
