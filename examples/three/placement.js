// Where the model of a `.hyrf` file is in a scene of three.js, and how a camera of three.js sees it.

import { Group, Matrix4, Quaternion, Vector3 } from "three";
import { IDENTITY_QUAT } from "hyrf.js/rotation.js";

/**
 * Returns a group in the model's local units and axes, whose parent is in the file's world units.
 * @param {import("hyrf.js/metadata.js").Config["frame"]} frame
 */
export function modelFrame({ center, scale, rotation = IDENTITY_QUAT }) {
  const group = new Group(), [w, ...vector] = rotation;
  group.position.set(...center);
  group.quaternion.set(...vector, w).normalize();
  group.scale.setScalar(scale);
  return group;
}

/**
 * Returns the rotation that makes the up direction of a file +y.
 * @param {number[]} up unit vector
 */
export const upright = (up) => new Quaternion().setFromUnitVectors(new Vector3(...up), new Vector3(0, 1, 0));

/**
 * Returns a view for `RemoteModel.look`, the `eye` in local units, and `unit`, the length of a local unit in those of
 * the camera.
 * @param {import("three").Camera} camera a perspective camera
 * @param {Group} frame from `modelFrame`, with its world matrix up to date
 * @param {number} width of the picture in pixels
 * @param {number} height
 */
export function viewOf(camera, frame, width, height) {
  const { elements: p } = camera.projectionMatrix;
  const pose = new Matrix4().multiplyMatrices(camera.matrixWorldInverse, frame.matrixWorld), { elements: e } = pose;
  const unit = Math.cbrt(Math.abs(pose.determinant()));
  // OpenCV's cameras look along +z with y down; those of three.js look along -z with y up.
  const rows = [0, 1, 2].map((k) => [e[k], e[4 + k], e[8 + k]].map((value) => (k ? -value : value) / unit));
  const translation = [e[12], -e[13], -e[14]].map((value) => value / unit);
  const view = {
    rows, translation, width, height,
    fx: (p[0] * width) / 2, fy: (p[5] * height) / 2, cx: ((1 - p[8]) * width) / 2, cy: ((1 + p[9]) * height) / 2,
  };
  const eye = [0, 1, 2].map((k) => -rows.reduce((sum, row, axis) => sum + row[k] * translation[axis], 0));
  return { view, eye, unit };
}
