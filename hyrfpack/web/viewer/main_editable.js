// The script of a page that plays scenes and edits them.

import { Editor } from "./edit/editor.js";
import { startPage } from "./page.js";
import { STREAMING } from "./stream/stream_loader.js";

startPage({ startEditing: (parts) => new Editor(parts), streaming: STREAMING });
