// Unpacks the player's texts into script elements, which other scripts find by their ids, and runs the player. The
// page's content security policy allows only this script and the player's. Until the player runs, `hyrfpack.ready` is a
// promise that follows the player's own.

{
  // Decompresses a JSON text in base64.
  const unpack = async (text) => {
    if (!window.DecompressionStream) throw new Error("This browser is too old for this page; use a newer one.");
    const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
    return JSON.parse(await new Response(stream).text());
  };

  // Adds a script element to the page.
  const put = (type, id, text) => {
    const script = Object.assign(document.createElement("script"), { type, id });
    script.append(text);
    document.body.append(script);
  };

  const boot = async () => {
    const { "main.js": main, ...texts } = await unpack(document.getElementById("player").textContent);
    for (const [name, text] of Object.entries(texts)) put("text/plain", name, text);
    put("text/javascript", "main.js", main);
  };

  const booted = boot(), loading = { ready: booted.then(() => window.hyrfpack !== loading && window.hyrfpack.ready) };
  window.hyrfpack = loading;
  loading.ready.catch(() => {}); // the page shows the error
  booted.catch(({ message }) => {
    document.getElementById("sentence").textContent = message;
    document.getElementById("message").hidden = false;
  });
}
