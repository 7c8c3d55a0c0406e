/** Where this server is: at the root of its address, or in a folder of a proxy's. */

const ROOT = new URL("../../", import.meta.url).pathname;

/** The address of a path of the server's, "/v1/jobs". What has it already, or is elsewhere, stays as it is. */
export function at(path) {
  if (!path.startsWith("/") || (ROOT !== "/" && path.startsWith(ROOT))) return path;
  return ROOT + path.slice(1);
}
