/** A test piece that measures the mill and a finish: its programs, its photograph, and figures for this job. */

import { saveLink } from "../job/save.js";
import { h } from "../lib/dom.js";
import { t } from "../lib/language.js";
import { photograph } from "../lib/photograph.js";
import { at } from "../lib/root.js";
import { sentence } from "../lib/words.js";

/** {nodes, show(profile)}: of the machine that the job is for. take({what, values}): called when a person uses the figures. */
export function couponPart({ take }) {
  let profile = "";
  const address = () => `/v1/profiles/${encodeURIComponent(profile)}/coupon`;
  const link = saveLink({ url: "", name: "", words: t("Programs and sheet (zip)"), fetched: true }); // it may be refused
  const photo = photograph({
    words: t("Photograph of its light"),
    address: () => `${address()}/photos`,
    lines,
    alt: () => t("The photograph, straightened, and how much of each ripple is left"),
  });

  function show(chosen) {
    if (chosen === profile) return;
    profile = chosen;
    link.href = at(`${address()}.zip`);
    link.download = `coupon-${profile}.zip`;
    photo.clear(); // it belonged to another mill
  }
  function lines({ finish, mill, notes, values }) {
    const instead = { "finish.minutes": undefined, "finish.depth_um": undefined }; // of a finish that was planned
    const use = () => take({ what: t("the figures of the test piece"), values: { ...instead, ...values } });
    return [
      t`Of a wave of ${round(halfMm(finish))} mm, the finish leaves half (k0 ${round(finish.k0_rad_per_mm)} rad/mm, order ${round(finish.order)}).`,
      t`The mill's rows are off by ${round(1000 * mill.z_noise_mm)} µm.`,
      ...notes.map((note) => sentence(note.text)),
      h("button", { type: "button", onclick: use }, t("Use these figures for this job")),
    ];
  }
  const steps = [
    [t("Mill a piece of 40 × 20 mm, in half an hour. The first time, its programs take about 15 s to make."), link],
    [t("Finish one half of it as you would finish a lens. The sheet has the steps.")],
    [t("Photograph its light: the result says how exact the mill is and how much your finish takes off."), photo.button],
  ];
  return { nodes: [h("ol", { class: "coupon" }, steps.map((step) => h("li", {}, step))), ...photo.node], show };
}

/** Period of which half is left [mm]: H(k) = exp(-(k / k0)^order) = 1/2. */
function halfMm({ k0_rad_per_mm, order }) {
  return (2 * Math.PI) / (k0_rad_per_mm * Math.log(2) ** (1 / order));
}

const round = (value) => String(Number(value.toPrecision(2)));
