// Moves a camera of three.js to the pose of a camera of a `.hyrf` file.

import { Matrix4, Vector3 } from "three";

/**
 * Moves a perspective camera to the pose of one of the file's cameras, and sets its vertical field of view.
 * @param {import("three").PerspectiveCamera} camera
 * @param {import("three").Object3D} object from `HyrfObject.load` or `loadHyrf`
 * @param {import("hyrf.js/viewpoint.js").Camera} [from] by default the first of `userData.hyrf.cameras`
 */
export function lookFrom(camera, object, from = object.userData.hyrf.cameras[0]) {
  const { near, far } = object.userData.hyrf;
  object.updateWorldMatrix(true, false);
  const pose = new Matrix4().set(...from.camera_from_world.flat()).invert();
  // OpenCV's cameras look along +z with y down; those of three.js look along -z with y up.
  pose.premultiply(object.matrixWorld).multiply(new Matrix4().makeScale(1, -1, -1));
  pose.decompose(camera.position, camera.quaternion, new Vector3());
  const size = Math.cbrt(Math.abs(object.matrixWorld.determinant()));
  camera.fov = (2 * Math.atan(from.height / (2 * from.fy)) * 180) / Math.PI;
  camera.near = near * size;
  camera.far = far * size;
  camera.updateProjectionMatrix();
  camera.updateMatrixWorld();
}
