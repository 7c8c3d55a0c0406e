/** The light on the wall, large: while the lens is made, the picture of it that is there; then the next steps, the finished ones ticked. */
import { h, replace } from "../lib/dom.js";
import { t } from "../lib/language.js";
import { isGoing, mark } from "../lib/state.js";
import { capital, hours, within } from "../lib/words.js";
import { eyeWords, isFine, isHard } from "./eye_words.js";
import { unfold } from "./fold.js";
import { likenessOf, millSeconds } from "./figures.js";
import { knownMills, sendLink, unmilledOf } from "./files.js";
import { ON_THE_WALL, pictureShelf } from "./pictures.js";
import { sheetLink, sheetOf } from "./save.js";
import { mills } from "../machine/mills.js";
import { addressOf, hasLiveRun } from "../machine/words.js";

const ASKED = "target.png";
const SEEN = ON_THE_WALL.filter(({ name }) => name !== ASKED); // from ideal to real

/** {node, update(job, artifacts), free()}; a job that stopped has none. */
export function endingPart() {
  const shelf = pictureShelf();
  const picture = h("img", { class: "ending-picture", alt: "" }), next = h("div", { class: "stack" });
  const node = h("section", { class: "ending", "aria-labelledby": "ending-title", hidden: true }, picture, next);
  let shown = "";

  async function update(job, artifacts) {
    const isMade = job.state === "succeeded";
    const seen = (isMade ? SEEN : ON_THE_WALL).findLast(({ name }) => artifacts.has(name));
    node.hidden = isMade ? !seen : !isGoing(job);
    const key = isMade ? artifacts.get(seen?.name)?.sha256 : `${seen?.name} ${freeMills().map(({ name }) => name)}`;
    if (node.hidden || key === shown) return;
    shown = key;
    const isKnown = seen && seen.name !== ASKED;
    picture.alt = isKnown ? t`On the wall, ${within(seen.title)}` : "";
    picture.classList.toggle("asked", !isKnown);
    replace(next, isMade ? words(job, artifacts, job.programs, []) : makingWords(job, seen));
    const loaded = seen && shelf.get(artifacts.get(seen.name)).then((url) => key === shown && (picture.src = url), () => {});
    if (!isMade) return;
    const [toMill, known] = await Promise.all([unmilledOf(job), knownMills(), loaded]);
    replace(next, words(job, artifacts, toMill, known));
  }
  return { node, update, free: shelf.free };
}

function freeMills() {
  return mills.seen.machines.filter((machine) => !hasLiveRun(machine));
}

/** seen: the picture that exists by now, if any. */
function makingWords(job, seen) {
  const free = freeMills(), to = free.length === 1 ? `${addressOf(free[0].name)}?job=${job.id}` : "#/machines";
  const now = seen && (seen.name === ASKED ? t("the picture as asked for: its light is not worked out yet") : t`On the wall, ${within(seen.title)}`);
  const ready = free.length > 0 && h("p", {}, h("a", { class: "button", href: to }, t("Get the mill ready meanwhile")));
  return [h("h2", { id: "ending-title" }, t("Your lens is being made")), now && h("p", { class: "dim" }, capital(now), "."), ready];
}

function words(job, artifacts, toMill, mills) {
  const { report, programs } = job, isMilled = programs.length > 0 && toMill.length === 0;
  const finish = report?.finishing?.steps.length > 0 && report.finishing;
  const seen = likenessOf(report?.as_finished) ?? likenessOf(report?.as_milled) ?? likenessOf(report?.optics);
  const sheet = sheetOf(artifacts);
  const share = shareWords(programs.length - toMill.length, programs.length, hours(millSeconds(report) ?? NaN));
  const [program, mill] = [toMill[0], mills[0]];
  const send = program && mill && sendLink(job, program, mill, { alone: mills.length === 1, first: true });
  const steps = [
    [isMilled, t("Mill it"), share, !isMilled && [send, jump(".programs-part", t("Programs")), sheet && sheetLink(sheet, t("Setup sheet"))]],
    finish && [false, t("Finish it by hand"), hours(60 * finish.minutes), [jump(".finishing-part", t("How"))]],
    artifacts.has("heightfield.npz") && [false, t("Shine light through it"), t("a photograph says what is off"), [jump(".photo-part", t("Photograph"))]],
  ];
  const better = h("a", { href: `#/new?from=${job.id}&show=more` }, t("What would show more?"));
  const title = isMilled ? t("Your lens is milled") : t("Your lens is ready to mill");
  const isGood = isFine(seen), line = isGood ? t`A fine lens: ${eyeWords(seen)}.` : t`On the wall: ${eyeWords(seen)}. `;
  return [h("h2", { id: "ending-title" }, title), seen !== undefined && h("p", { class: isGood ? "fine" : "" }, line, !isMilled && isHard(seen) && better), h("ol", {}, steps.filter(Boolean).map(step))];
}

function shareWords(milled, all, time) {
  if (milled > 0) return all === 1 ? t`${milled} of ${all} program milled` : t`${milled} of ${all} programs milled`;
  return all === 1 ? t`${all} program, ${time}` : t`${all} programs, ${time}`;
}

function step([done, what, more, links]) {
  return h("li", {}, h("strong", {}, what), " ", done ? mark("good", t("done")) : h("span", { class: "dim" }, more), h("div", { class: "row" }, links));
}

/** A button that unfolds a part farther down. */
function jump(to, words) {
  const go = () => {
    const part = document.querySelector(to);
    unfold(part);
    part.scrollIntoView();
  };
  return h("button", { type: "button", onclick: go }, words);
}
