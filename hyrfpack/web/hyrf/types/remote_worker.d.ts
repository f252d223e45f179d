export type View = import("./frustum.js").View;
