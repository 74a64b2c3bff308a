// What the page holds: facts and gallery as JSON, splats as base64 or in a file beside the page.

const readJson = (id, page = document) => JSON.parse(page.getElementById(id).textContent);

/** The bytes of a base64 text. */
function fromBase64(text) {
  const binary = atob(text.trim());
  const bytes = new Uint8Array(binary.length);
  for (let i = 0; i < bytes.length; i++) bytes[i] = binary.charCodeAt(i);
  return bytes;
}

/** The bytes of the splats; `sideFile` is where they lie if the page does not hold them. */
async function splatBytes(sideFile, page = document) {
  if (!sideFile) {
    const element = page.getElementById("splats");
    const bytes = fromBase64(element.textContent);
    element.remove();
    return bytes;
  }
  if (location.protocol === "file:") {
    throw new Error(`This scene is too large for one page, and a page from disk may not read ${sideFile} beside it. “limpid view” with the run's folder shows it.`);
  }
  const reply = await fetch(sideFile);
  if (!reply.ok) throw new Error(`${sideFile} does not come: ${reply.status} ${reply.statusText}`);
  return new Uint8Array(await reply.arrayBuffer());
}
