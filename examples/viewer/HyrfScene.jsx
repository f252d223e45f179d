// A React component that shows a scene.

import { createViewer } from "hyrf-viewer";
import { useEffect, useRef } from "react";

// `src`, `exposure` and `autorotate` are followed; `onReady` and `onError` are called with the viewer's events.
export function HyrfScene({ src, exposure = "as-photographed", autorotate = false, onReady, onError, className }) {
  const container = useRef(null), viewer = useRef(null), callbacks = useRef({});
  callbacks.current = { onReady, onError };

  useEffect(() => {
    const created = createViewer({ container: container.current });
    created.on("ready", (event) => callbacks.current.onReady?.(event));
    created.on("error", (event) => callbacks.current.onError?.(event));
    viewer.current = created;
    return () => created.destroy();
  }, []);

  useEffect(() => {
    viewer.current.load(src).catch(() => {}); // the events report errors
  }, [src]);

  useEffect(() => {
    viewer.current.exposure = exposure;
    viewer.current.autorotate = autorotate;
  }, [exposure, autorotate]);

  return <div ref={container} className={className} />;
}
