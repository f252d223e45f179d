// Sorts keys on the device, see sort.wgsl.

import { readShader } from "./shaders.js";

const KEYS_PER_BLOCK = 2048; // 8 tiles of 256
const DIGITS = 256;
const SHIFTS = [0, 8, 16, 24]; // of the digit of each pass

export class RadixSort {
  // `keys` is a buffer of `count` keys, 32 bits each; `pipelines` are from `compile`.
  constructor(objects, pipelines, keys, count) {
    const pairs = [0, 1].map(() => objects.buffer(8 * count));
    const blocks = Math.max(1, Math.ceil(count / KEYS_PER_BLOCK)), starts = objects.buffer(4 * DIGITS * blocks);
    const sorted = objects.buffer(4), { STORAGE, INDIRECT, UNIFORM } = GPUBufferUsage;
    this.blocks = blocks;
    this.pipelines = pipelines;
    this.drawArguments = objects.buffer(28, STORAGE | INDIRECT); // of drawIndirect, and then of the later passes
    this.order = pairs[SHIFTS.length % 2 ? 0 : 1]; // pairs of key and index
    this.passes = SHIFTS.map((shift, number) => {
      const digit = objects.upload(Uint32Array.of(shift, count), UNIFORM), after = pairs[number % 2];
      const before = pairs[1 - (number % 2)], { count: counting, scan, scatter } = pipelines;
      return [
        objects.group(counting, [digit, keys, before, , starts, sorted]),
        objects.group(scan, [digit, , , , starts, sorted, this.drawArguments]),
        objects.group(scatter, [digit, keys, before, after, starts, sorted]),
      ];
    });
  }

  static async compile(objects) {
    const code = readShader("sort.wgsl"), names = ["count", "scan", "scatter"];
    const compiled = await Promise.all(names.map((name) => objects.computePipeline("sort.wgsl", code, name)));
    return Object.fromEntries(names.map((name, number) => [name, compiled[number]]));
  }

  // Adds the sort to a compute pass. `order` then has the keys that are not SKIPPED, in ascending order.
  encode(pass) {
    const { count, scan, scatter } = this.pipelines;
    this.passes.forEach((groups, number) => {
      [count, scan, scatter].forEach((pipeline, step) => {
        pass.setPipeline(pipeline);
        pass.setBindGroup(0, groups[step]);
        if (pipeline === scan) pass.dispatchWorkgroups(1);
        else if (number) pass.dispatchWorkgroupsIndirect(this.drawArguments, 16);
        else pass.dispatchWorkgroups(this.blocks);
      });
    });
  }
}
