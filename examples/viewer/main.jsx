// A page with the component of HyrfScene.jsx.

import { StrictMode, useState } from "react";
import { createRoot } from "react-dom/client";

import { HyrfScene } from "./HyrfScene.jsx";

function App() {
  const [status, setStatus] = useState("Loading"), [isShown, setShown] = useState(true);
  return (
    <>
      {isShown && (
        <HyrfScene
          className="scene"
          src="scene.hyrf"
          onReady={({ scene }) => setStatus(`${scene.count} Gaussians`)}
          onError={({ error }) => setStatus(error.message)}
        />
      )}
      <output id="status">{status}</output>
      <button onClick={() => setShown(!isShown)}>{isShown ? "Remove" : "Show"}</button>
    </>
  );
}

createRoot(document.getElementById("root")).render(<StrictMode><App /></StrictMode>);
