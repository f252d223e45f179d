// Recognises files that are no scenes, so that the message can say what they are.

import { HyrfFormatError } from "../hyrf/errors.js";

const TESTED_BYTES = 256;
// Patterns are long enough that the numbers of a .splat file, which has no header, practically never match.
// Texts may begin with a byte order mark.
const OTHER_KINDS = [
  [/^\W*<(!doctype html|html|head|body|script)/i,
    "a web page (HTML) and no scene; its server may have answered with an error page, so check the address"],
  [/^\W*<\?xml/i, "an XML text and no scene; its server may have answered with an error"],
  [/^\s*\{\s*"background":/, // the first key of a scene.json, because they are sorted
    "only the list of a scene folder; serve the folder, or use 'hyrfpack view FOLDER'"],
  [/^\s*\{\s*"\w+"\s*:/, "a JSON text and no scene; its server may have answered with an error"],
  [/^version https:\/\/git-lfs/, "only a pointer to the file in Git LFS; fetch the file itself by git lfs pull"],
  [/^\xff\xd8\xff/, "a JPEG picture and no scene"],
  [/^\x89PNG\r\n/, "a PNG picture and no scene"],
  [/^GIF8\d/, "a GIF picture and no scene"],
  [/^RIFF[^]{4}WEBP/, "a WebP picture and no scene"],
  [/^[^]{4}ftyp/, "a video, or an AVIF or HEIC picture, and no scene"],
  [/^%PDF-/, "a PDF document and no scene"],
  [/^glTF/, "a glTF model and no splats"],
];

// Throws an error that says what a file is, if it is empty or of another kind.
export function rejectOtherFiles(bytes) {
  if (!bytes.length) throw new HyrfFormatError("it is empty (0 bytes); fetch or write it again.");
  const start = String.fromCharCode(...bytes.subarray(0, TESTED_BYTES));
  const kind = OTHER_KINDS.find(([pattern]) => pattern.test(start));
  if (kind) throw new HyrfFormatError(`it is ${kind[1]}.`);
}
