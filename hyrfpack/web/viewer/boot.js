// Unpacks the player's texts into script elements, which other scripts find by their ids, and runs the player. The
// page's content security policy allows only this script and the player's. Until the player runs, `hyrfpack.ready` is a
// promise that follows the player's own.

{
  const find = (name) => document.getElementById(name);

  // Sends a message to the page around this one, where <hyrf-viewer> waits for the first one.
  const postToParent = (hyrf, message) => window.parent !== window && window.parent.postMessage({ hyrf, message }, "*");

  // Decompresses a JSON text in base64.
  const unpack = async (text) => {
    if (!window.DecompressionStream) throw new Error("This browser is too old for this page; use a newer one.");
    const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
    return new Response(stream).json().catch(() => {
      throw new Error("The player in this page is damaged; load the page again.");
    });
  };

  // Adds a script element to the page.
  const put = (type, id, text) => {
    const script = Object.assign(document.createElement("script"), { type, id });
    script.append(text);
    document.body.append(script);
  };

  const boot = async () => {
    const { "main.js": main, ...texts } = await unpack(find("player").textContent);
    for (const [name, text] of Object.entries(texts)) put("text/plain", name, text);
    put("text/javascript", "main.js", main);
    if (window.hyrfpack !== loading || !find("message").hidden) return;
    throw new Error("A Content-Security-Policy forbids the player's script; allow the scripts that this page allows.");
  };

  document.body.classList.add("started");
  find("page").hidden = false;
  find("stalled").remove();
  postToParent("start");

  const booted = boot(), loading = { ready: booted.then(() => window.hyrfpack !== loading && window.hyrfpack.ready) };
  window.hyrfpack = loading;
  loading.ready.catch(() => {}); // the page shows the error
  booted.catch(({ message }) => {
    find("loading").hidden = true;
    find("sentence").textContent = message;
    find("message").hidden = false;
    postToParent("error", message);
  });
}
