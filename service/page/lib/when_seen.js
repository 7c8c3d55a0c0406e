/** Work that waits until its result is visible. */

/** Calls `work` when the node comes into view, and by `again()` once more if it is; {again(), seen(), end()}.
 * @param {(seen: boolean) => void} onChange */
export function whenSeen(node, work, onChange = () => {}) {
  let seen = false;
  const watch = new IntersectionObserver((entries) => {
    seen = entries.at(-1).isIntersecting;
    onChange(seen);
    if (seen) work();
  }, { rootMargin: "200px" });
  watch.observe(node);
  return { again: () => seen && work(), seen: () => seen, end: () => watch.disconnect() };
}
