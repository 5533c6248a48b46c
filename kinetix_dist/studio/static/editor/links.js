// A level as a link: behind the # of any address of the editor, so that no server sees it and every installation opens it.
//   #/edit?level=1.eJx...   version, then the level's JSON, deflated with a checksum (zlib), base64url
//   #/edit?level=q1Yq...    links from before there were versions: deflated without a checksum
// kinetix_dist/studio/server/level_links.py reads the same.

export const LINK_VERSION = 1;
const MAX_LEVEL_TEXT = 3_000_000; // characters: a few bytes of a link can be many
const ADDRESS = /^(?:https?:\/\/|#\/)/;
const LINK = /(?:^|[#?&])level=([^&#\s]*)/;

/** The level of a link, of the part behind its #, or of `level=...` alone; "" of an address without a level, which
 * `levelTextOf` refuses; null: the text is no link. @param {string} text @returns {string | null} */
export function linked(text) {
  const trimmed = text.trim();
  if (trimmed.startsWith("{") || /\s/.test(trimmed)) return null;
  return LINK.exec(trimmed)?.[1] ?? (ADDRESS.test(trimmed) ? "" : null);
}

/** The level for a link. @param {any} document @returns {Promise<string>} */
export async function packed(document) {
  const stream = new Blob([JSON.stringify(document)]).stream().pipeThrough(new CompressionStream("deflate"));
  const bytes = new Uint8Array(await new Response(stream).arrayBuffer());
  const text = btoa(Array.from(bytes, (byte) => String.fromCharCode(byte)).join("")).replaceAll("+", "-").replaceAll("/", "_").replace(/=+$/, "");
  return `${LINK_VERSION}.${text}`;
}

/** Text of the level of a link. Throws an Error with one line. @param {string} packed @returns {Promise<string>} */
export async function levelTextOf(packed) {
  const [, version, text] = /^(?:(\d+)\.)?([\w-]+)$/.exec(packed) ?? [];
  if (text === undefined) throw new Error("this link is damaged: it holds no level; copy all of it again");
  if (version !== undefined && Number(version) !== LINK_VERSION) throw new Error(`this link is of version ${version}, this installation reads version ${LINK_VERSION}; open it with a newer kinetix-dist`);
  try {
    return await inflated(text, version === undefined ? "deflate-raw" : "deflate");
  } catch (error) {
    if (error instanceof RangeError) throw error;
    throw new Error("this link is damaged or cut off; copy all of it again");
  }
}

/** @param {string} text @param {CompressionFormat} format */
async function inflated(text, format) {
  const bytes = Uint8Array.from(atob(text.replaceAll("-", "+").replaceAll("_", "/")), (character) => character.charCodeAt(0));
  const reader = new Blob([bytes]).stream().pipeThrough(new DecompressionStream(format)).getReader();
  const decoder = new TextDecoder("utf-8", { fatal: true });
  let result = "";
  for (let part = await reader.read(); !part.done; part = await reader.read()) {
    result += decoder.decode(part.value, { stream: true });
    if (result.length > MAX_LEVEL_TEXT) throw new RangeError("the level of this link is too large");
  }
  return result + decoder.decode();
}
