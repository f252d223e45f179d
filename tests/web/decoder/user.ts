// A user's program that must compile against the types of hyrf.js.

import { describe, HyrfError, HyrfFormatError, read } from "hyrf.js";
import type { Model } from "hyrf.js";
import { logGains } from "hyrf.js/exposure.js";
import { colorsAlong, decodeGeometry, firstLayers } from "hyrf.js/fields.js";
import { frustumPlanes } from "hyrf.js/frustum.js";
import type { View } from "hyrf.js/frustum.js";
import { gridLevels } from "hyrf.js/grids.js";
import { fitHarmonics } from "hyrf.js/harmonics.js";
import { selectLevels } from "hyrf.js/levels.js";
import { parseManifest } from "hyrf.js/manifest.js";
import { openRemoteModel } from "hyrf.js/remote.js";
import type { EvaluatedRow, RemoteModel } from "hyrf.js/remote.js";
import { RowStates, rowBalls } from "hyrf.js/row_states.js";
import { backgroundSpacing, backgroundStride, pixelSizes } from "hyrf.js/sampling.js";
import { DepthSort } from "hyrf.js/sort.js";
import type { Camera } from "hyrf.js/viewpoint.js";
import { viewpointOf } from "hyrf.js/viewpoint.js";

export async function readChunk(bytes: Uint8Array, shared: Uint8Array): Promise<Model> {
  return read(bytes, { openFile: async (name: string) => (name === "shared.hyrf" ? shared : new Uint8Array(0)) });
}

export function chooseFiles(bytes: Uint8Array, camera: Camera): (string | undefined)[] {
  const manifest = parseManifest(bytes), { levels } = selectLevels(manifest, camera, { gaussians: 1000 });
  return levels.map((level, number) => manifest.chunks[number]?.levels[level]?.file);
}

export async function evaluate(bytes: Uint8Array): Promise<Float32Array> {
  const { firstLayer, sections } = describe(bytes);
  const model: Model = await read(bytes.subarray(0, firstLayer), { partial: true });
  const { quats } = decodeGeometry(model, 0, model.count), [gain] = model.exposure
    ? logGains(model.exposure, [0, 0, 0], [0, 0, 1])
    : [0];
  console.log(quats.length, gain, sections.map(({ type }) => type), gridLevels(model.config.radiance).length);
  const { fitted, up } = viewpointOf(model.metadata);
  const splats = await fitHarmonics(model, fitted, 2, ({ done }) => console.log(done, up));
  return colorsAlong(model, firstLayers(model, 0, splats.count), 0, splats.count, model.positions);
}

export function sort(model: Model, view: View): Uint32Array {
  const planes = frustumPlanes(view, 0), row = view.rows[2];
  if (!row) throw new RangeError("The view has no third row.");
  const { rows } = new RowStates(rowBalls(model.positions, 256)).stale(planes, [0, 0, 0], 0);
  console.log(rows.length);
  return new DepthSort(model.positions, 256).sort(row, planes, 0.01).order;
}

export function limitDetail(model: Model, view: View): [Float32Array, number] {
  return [pixelSizes(model.positions, model.metadata), backgroundStride(backgroundSpacing(model.metadata), view)];
}

export async function open(view: View, receive: (row: EvaluatedRow) => void): Promise<RemoteModel | null> {
  try {
    const model = await openRemoteModel("scene.hyrf", {
      onOrder: (order, drawn) => model.reuse(order.fill(0, drawn)),
      onRow: receive,
      onTile: ({ x, y, pixels }) => console.log(x + y, pixels.byteLength),
      onError: (error: HyrfError) => console.error(error.message),
      onProgress: ({ step, part }) => console.log(step, part.toFixed(2)),
    });
    const isComplete: boolean = await model.look(view);
    return isComplete ? model : null;
  } catch (error) {
    if (error instanceof HyrfFormatError) return null;
    throw error;
  }
}
