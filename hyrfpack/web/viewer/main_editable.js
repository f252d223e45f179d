// The script of a page that plays scenes and edits them.

import { Editor } from "./edit/editor.js";
import { startPage } from "./page.js";

startPage((parts) => new Editor(parts));
