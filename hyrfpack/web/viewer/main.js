// The script of a page that plays the scene in it, or files that are dropped on it.

import { startPage } from "./page.js";

startPage();
