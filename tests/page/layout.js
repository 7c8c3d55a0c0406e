/**
 * Laws of a screen, for a hand in a glove and an eye at a distance: (page as it is now) -> sentences about what breaks
 * them. Nothing is wider than the screen, no words are cut, broken within a button or lie over others, inputs of a row
 * stand on one line, no control lies in another's way or is too small to hit. What scrolls inside itself may be larger;
 * what is laid over the page is judged by itself.
 */
({ least }) => {
  const CONTROLS = "a[href], button, select, textarea, input, summary, [role=radio], canvas[tabindex]";
  const SLACK = 1.5; // px
  const modal = document.querySelector("dialog:modal");
  const scope = modal ?? document.body;
  const all = [...scope.querySelectorAll("*")].filter(isShown);

  /** Words for screen readers, and the way past the navigation while nobody needs it, are out of sight. */
  function isShown(one) {
    return one.checkVisibility({ visibilityProperty: true }) && !one.closest(".hidden-words, .skip:not(:focus), noscript");
  }
  function name(one) {
    const words = one.getAttribute("aria-label") ?? one.textContent.trim().replace(/\s+/g, " ").slice(0, 50);
    return `${one.tagName.toLowerCase()}.${one.getAttribute("class") ?? ""} "${words}"`;
  }
  /** What is left of a rectangle in the parts of the page around it; null where nothing is. */
  function seen(box, one) {
    let { left, top, right, bottom } = box;
    for (let around = one; around && around !== document.body; around = around.parentElement) {
      if (getComputedStyle(around).overflow === "visible") continue;
      const own = around.getBoundingClientRect();
      [left, top] = [Math.max(left, own.left), Math.max(top, own.top)];
      [right, bottom] = [Math.min(right, own.right), Math.min(bottom, own.bottom)];
    }
    return right - left > SLACK && bottom - top > SLACK ? { left, top, right, bottom } : null;
  }
  /** What moves together: the page, a bar that sticks to an edge, words that are laid over all. */
  function layer(one) {
    for (let around = one; around; around = around.parentElement) {
      if (["fixed", "sticky"].includes(getComputedStyle(around).position)) return around;
    }
    return null;
  }
  function meet(a, b) {
    return Math.min(a.right, b.right) - Math.max(a.left, b.left) > SLACK
      && Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top) > SLACK;
  }

  function wide() {
    const width = document.documentElement.clientWidth;
    if (document.documentElement.scrollWidth <= width) return [];
    const boxes = all.filter((one) => one.getBoundingClientRect().right > width + 1);
    return boxes.length ? boxes.map((one) => `sticks out: ${name(one)}`) : ["the page scrolls sideways"];
  }

  /** [{one, box}] of every line of words. */
  function lines() {
    return all.filter((one) => !one.ownerSVGElement && one.tagName !== "OPTION").flatMap((one) =>
      [...one.childNodes].filter((node) => node.nodeType === Node.TEXT_NODE && node.data.trim()).flatMap((node) => {
        const range = document.createRange();
        range.selectNodeContents(node);
        return [...range.getClientRects()].filter(({ width }) => width > 0).map((box) => ({ one, box }));
      }),
    );
  }
  /** Words beyond the edge of what cuts them off, or out of the box that they are drawn in. */
  function cut(found) {
    const beyond = ({ one, box }) => {
      for (let around = one; around && around !== document.body; around = around.parentElement) {
        const style = getComputedStyle(around), own = around.getBoundingClientRect();
        const scrolls = /auto|scroll/.test(style.overflow);
        if (scrolls) return false;
        const framed = style.overflow !== "visible" || style.borderLeftWidth !== "0px" && style.borderLeftStyle !== "none";
        if (!framed || style.display === "inline") continue;
        if (box.right > own.right + SLACK || box.left < own.left - SLACK) return true;
        if (box.bottom > own.bottom + 4 || box.top < own.top - 4) return true;
      }
      return false;
    };
    return [...new Set(found.filter(beyond).map(({ one }) => one))]
      .filter((one) => !isSummary(one))
      .map((one) => `cut: ${name(one)}`);
  }
  /** Some lines of what stands in full where the link leads. */
  function isSummary(one) {
    const { webkitLineClamp, overflow } = getComputedStyle(one);
    return webkitLineClamp !== "none" && overflow === "hidden" && one.closest("a[href]");
  }
  function overWords(found) {
    const shown = found.map((line) => ({ ...line, box: seen(line.box, line.one), on: layer(line.one) })).filter(({ box }) => box);
    const faults = new Set();
    shown.forEach((a, k) => shown.slice(k + 1).forEach((b) => {
      if (a.one !== b.one && a.on === b.on && meet(a.box, b.box)) faults.add(`words over words: ${name(a.one)} and ${name(b.one)}`);
    }));
    return [...faults];
  }

  /** Words in a field that are wider than it: what is usual, figures with their unit, what is chosen. */
  function cutFields() {
    const ink = document.createElement("canvas").getContext("2d");
    return all.filter((one) => one.matches("select, input:not([type=radio], [type=checkbox], [type=range], [type=file])")).filter((one) => {
      const style = getComputedStyle(one), words = getComputedStyle(one, shown(one) === one.placeholder ? "::placeholder" : null);
      ink.font = `${words.fontWeight} ${words.fontSize} ${words.fontFamily}`;
      const arrow = one.tagName === "SELECT" ? 18 : 0;
      const room = one.clientWidth - parseFloat(style.paddingLeft) - parseFloat(style.paddingRight) - arrow;
      return ink.measureText(shown(one)).width > room + SLACK;
    }).map((one) => `cut in its field: ${name(one)} shows "${shown(one)}"`);
  }
  /** A text that a person writes may be longer than its field. */
  function shown(one) {
    if (one.tagName === "SELECT") return one.selectedOptions[0]?.textContent ?? "";
    if (!one.value) return one.placeholder;
    return one.inputMode === "decimal" || one.type === "number" ? one.value : "";
  }

  /** Words of a button that end on another line than they begin; names that people give may be long. */
  function broken() {
    const apart = (node) => [...node.data.matchAll(/[^\s-]+/g)].filter(([word]) => word.length <= 12).filter(({ 0: word, index }) => {
      const range = document.createRange();
      range.setStart(node, index);
      range.setEnd(node, index + word.length);
      return new Set([...range.getClientRects()].map(({ top }) => Math.round(top))).size > 1;
    });
    return all.filter((one) => one.closest("button, .button")).flatMap((one) =>
      [...one.childNodes].filter((node) => node.nodeType === Node.TEXT_NODE).flatMap(apart).map(([word]) => `broken in ${name(one)}: ${word}`),
    );
  }

  /** [{one, box}]: what a finger aims at; a tick or a radio is its whole label. */
  function controls() {
    const aims = all.filter((one) => one.matches(CONTROLS) && one.type !== "file").map((one) =>
      ["checkbox", "radio"].includes(one.type) ? (one.closest("label") ?? one) : one,
    );
    return [...new Set(aims)].map((one) => ({ one, box: seen(one.getBoundingClientRect(), one) })).filter(({ box }) => box);
  }
  function inTheWay(found) {
    const faults = [];
    const flat = found.filter(({ one }) => !one.ownerSVGElement).map((each) => ({ ...each, on: layer(each.one) }));
    flat.forEach((a, k) => flat.slice(k + 1).forEach((b) => {
      if (a.on !== b.on || a.one.contains(b.one) || b.one.contains(a.one) || !meet(a.box, b.box)) return;
      faults.push(`in the way: ${name(a.one)} and ${name(b.one)}`);
    }));
    return faults;
  }
  /** A link within a sentence is as large as its words. */
  function small(found) {
    const inSentence = (one) => one.tagName === "A" && getComputedStyle(one).display === "inline"
      && one.parentElement.textContent.trim() !== one.textContent.trim();
    return found
      .filter(({ one, box }) => !inSentence(one) && (box.right - box.left < least - 0.5 || box.bottom - box.top < least - 0.5))
      .filter(({ one }) => one.getBoundingClientRect().height < least - 0.5 || one.getBoundingClientRect().width < least - 0.5)
      .map(({ one, box }) => `small (${Math.round(box.right - box.left)} x ${Math.round(box.bottom - box.top)}): ${name(one)}`);
  }

  /** Inputs side by side that do not stand on one line, whatever is written above them. */
  function uneven() {
    const fields = all.filter((one) => one.matches(".fields > .field:not(:has(> .tick))"));
    const [top, at] = [(one) => one.getBoundingClientRect().top, (one) => one.children[1].getBoundingClientRect().top];
    return fields.filter((one, k) => {
      const before = fields[k - 1];
      const beside = before?.parentElement === one.parentElement && top(before) === top(one);
      return beside && Math.abs(at(before) - at(one)) > SLACK;
    }).map((one) => `out of line: ${name(one)}`);
  }

  const words = lines(), aims = controls();
  const ofWords = [...cut(words), ...overWords(words), ...cutFields(), ...broken()];
  return [...wide(), ...uneven(), ...ofWords, ...inTheWay(aims), ...small(aims)];
}
