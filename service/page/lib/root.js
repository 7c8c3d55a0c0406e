/** Where this server is: at the root of its address, or in a folder of a proxy's. */

const ROOT = new URL("../../", import.meta.url).pathname;

/** The address of a path of the server, such as "/v1/jobs". An address that is complete, or elsewhere, is unchanged. */
export function at(path) {
  if (!path.startsWith("/") || (ROOT !== "/" && path.startsWith(ROOT))) return path;
  return ROOT + path.slice(1);
}
