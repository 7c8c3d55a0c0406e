/** Words for the visual quality of a PSNR. */

import { t } from "../lib/language.js";

const EYE = [
  [60, t("no eye can tell it from the target")],
  [40, t("very close to the target")],
  [33, t("small differences, seen only side by side")],
  [27, t("plainly the picture; fine detail or tones are off")],
  [21, t("recognisable, visibly soft or uneven")],
  [-Infinity, t("hard to recognise")],
];

/** Whether the picture will be hard to recognise. */
export function isHard(psnrDb) {
  return psnrDb < EYE.at(-2)[0];
}

/** Whether a person sees differences from the picture only beside it. */
export function isFine(psnrDb) {
  return psnrDb >= EYE[2][0];
}

/** The word for the visual quality of a PSNR. */
export function eyeWords(psnrDb) {
  return EYE.find(([least]) => psnrDb >= least)[1];
}

/** Bands of PSNR with a word for each: [[from dB, to dB, word]], worst first. */
export function eyeBands(low, high) {
  const tops = [Infinity, ...EYE.map(([least]) => least)];
  const bands = EYE.map(([least, words], k) => [Math.max(least, low), Math.min(tops[k], high), words.split(/[,;、]/)[0]]);
  return bands.filter(([from, to]) => from < to).reverse();
}
