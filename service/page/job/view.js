/**
 * One job: how far it is, what its light will be, its lens, its paths, its programs.
 *
 * Events only say that something changed; the page then fetches the job, and every part shows its data. So a
 * page that was away, a server that was restarted, and a job that was tried again are all the same case.
 */
import { api } from "../lib/api.js";
import { h, replace, sheet } from "../lib/dom.js";
import { t } from "../lib/language.js";
import { follow } from "../lib/sse.js";
import { isGoing } from "../lib/state.js";
import { endingPart } from "./ending.js";
import { factsPart, warningsPart } from "./facts.js";
import { passesOf, screenOf } from "./figures.js";
import { unfold } from "./fold.js";
import { filesPart, programsPart } from "./files.js";
import { finishingPart } from "./finishing.js";
import { headPart } from "./head.js";
import { lensPart } from "./lens.js";
import { lightPart } from "./light.js";
import { pathPart } from "./path.js";
import { photoPart } from "./photo.js";
import { picturesPart } from "./pictures.js";
import { planPart } from "./plan.js";
import { progressPart } from "./progress.js";

const CONTENTS = ["progress", "warnings", "pictures", "light", "facts", "programs", "plan", "finishing", "lens", "path", "photo", "files"];
const GATHER_MS = 120;
const POSITION_MS = 4000; // a queue moves on without events of this job
const CLOCK_MS = 10_000; // after which times in words are updated

export default async function view(root, params, app) {
  const address = `/v1/jobs/${encodeURIComponent(params.id)}`;
  const [first] = await Promise.all([api.get(address), sheet("/page/job/job.css")]);
  const watched = { job: first, artifacts: new Map(), live: null, link: "open", left: false };
  const parts = makeParts(app, (job) => {
    watched.job = job;
    show();
    if (isGoing(job)) listen();
  });
  let stream = null, timer = 0, asking = null;

  function show() {
    const { job, artifacts, live, link } = watched;
    if (root.firstChild) root.firstChild.dataset.state = job.state;
    parts.head.update(job);
    parts.progress.update(job, live, link);
    parts.ending.update(job, artifacts);
    parts.facts.update(job);
    parts.warnings.update(job);
    parts.pictures.update(artifacts);
    parts.programs.update(job);
    parts.light.update(artifacts, job);
    parts.lens.update(artifacts, job.spec);
    parts.path.update(artifacts, { ...job.spec, passes: passesOf(job) });
    parts.photo.update(job, artifacts);
    parts.plan.update(job);
    parts.finishing.update(job);
    parts.files.update(job, artifacts);
  }
  /** Fetches the job as it is now; several requests at once become one. */
  function refresh() {
    asking ??= new Promise((done) => setTimeout(done, GATHER_MS)).then(load).finally(() => (asking = null));
    return asking;
  }
  async function load() {
    if (watched.left) return;
    try {
      const [job, files] = await Promise.all([api.get(address), api.get(`${address}/artifacts`)]);
      if (watched.left) return;
      watched.job = job;
      watched.artifacts = new Map(files.artifacts.map((file) => [file.name, file]));
      show();
      if (isGoing(job)) listen();
      clearTimeout(timer);
      if (job.state === "queued") timer = setTimeout(refresh, POSITION_MS);
    } catch (error) {
      if (error.status === 404) showGone(root, parts);
    }
  }
  function listen() {
    if (stream || watched.left) return;
    stream = follow(`${address}/events`, {
      onEvent(name, data) {
        if (name === "progress") {
          watched.live = data;
          parts.progress.update(watched.job, watched.live, watched.link);
        } else refresh();
      },
      onState(state) {
        watched.link = state;
        if (state === "ended") stream = null;
        parts.progress.update(watched.job, watched.live, watched.link);
        if (state !== "away") refresh();
      },
    });
  }
  const clock = setInterval(tick, CLOCK_MS);
  /** Update the times even if nothing else happens. */
  function tick() {
    parts.head.update(watched.job);
    parts.progress.update(watched.job, watched.live, watched.link);
    parts.ending.update(watched.job, watched.artifacts); // the mills are known a little later
  }
  const back = api.onAway((away) => !away && refresh());

  replace(root, layout(parts, first.spec));
  show();
  if (isGoing(first)) listen();
  await load();
  if (CONTENTS.includes(params.show) && !parts[params.show].node.hidden) {
    unfold(parts[params.show].node);
    parts[params.show].node.scrollIntoView();
  }
  return {
    leave() {
      watched.left = true;
      clearTimeout(timer);
      clearInterval(clock);
      back();
      stream?.close();
      for (const part of Object.values(parts)) part.free?.();
    },
  };
}

function makeParts(app, changed) {
  return {
    head: headPart(app, changed), progress: progressPart(), ending: endingPart(), facts: factsPart(), warnings: warningsPart(), pictures: picturesPart(),
    programs: programsPart(), light: lightPart(), lens: lensPart(), path: pathPart(), plan: planPart(), finishing: finishingPart(),
    photo: photoPart(),
    files: filesPart(),
  };
}

/** The parts in their places; pictures that come later find theirs kept free, so that nothing jumps. */
function layout(parts, spec) {
  const screen = screenOf(spec), { width_mm: width, height_mm: height } = spec.optics;
  return h(
    "div", { class: "job-view", style: { "--shape": screen.width / screen.height, "--lens-shape": width / height } },
    parts.head.node, parts.ending.node,
    h("div", { class: "job-parts" }, CONTENTS.map((name) => parts[name].node)),
  );
}

function showGone(root, parts) {
  for (const part of Object.values(parts)) part.free?.();
  replace(root, h("h1", {}, t("This job is gone")), h("p", {}, t("Somebody has deleted it.")), h("p", {}, h("a", { class: "button", href: "#/" }, t("All jobs"))));
}
