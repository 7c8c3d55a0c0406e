/** Figures and times in everyday words. */

import { language, locale, t } from "./language.js";

/** Seconds as "1 h 45 min", "12 min", "40 s"; from a day on "2 d 3 h". */
export function hours(seconds) {
  if (!Number.isFinite(seconds)) return t("unknown");
  const whole = Math.max(0, Math.round(seconds));
  if (whole < 60) return t`${whole} s`;
  const minutes = Math.round(whole / 60);
  if (minutes < 60) return t`${minutes} min`;
  if (minutes < 24 * 60) return minutes % 60 ? t`${Math.floor(minutes / 60)} h ${minutes % 60} min` : t`${minutes / 60} h`;
  const inHours = Math.round(minutes / 60);
  return inHours % 24 ? t`${Math.floor(inHours / 24)} d ${inHours % 24} h` : t`${inHours / 24} d`;
}

/** A length: "0.62 mm", "12.4 mm", "100 mm"; below 0.1 mm in µm. */
export function mm(length) {
  if (!Number.isFinite(length)) return t("unknown");
  const size = Math.abs(length);
  if (size > 0 && size < 0.0995) return `${figures(length * 1000, 2)} µm`;
  return `${figures(length, size < 10 ? 2 : 3)} mm`;
}

/** A ball's size, by its radius as in the spec and by its diameter as on its box: "R 3 (Ø 6 mm)". */
export function ball(radiusMm) {
  return `R\u00a0${figures(radiusMm, 3)} (Ø\u00a0${figures(2 * radiusMm, 3)}\u00a0mm)`;
}

const PASSES = { rough: t("rough"), finish: t("finish") };

/** The name of a pass: "rough" or "finish" from the planner, numbered if there are several; otherwise the person's own. */
export function passName(name) {
  return name.replace(/^(rough|finish)(?=$|-\d+$)/, (known) => PASSES[known]);
}

/** At least that many significant figures, without zeros at the end: figures(12.34, 2) = "12". */
export function figures(value, count) {
  if (!Number.isFinite(value)) return t("unknown");
  if (value === 0) return "0";
  const places = Math.max(0, count - 1 - Math.floor(Math.log10(Math.abs(value))));
  return String(Number(value.toFixed(Math.min(places, 12))));
}

/** "812 B", "13 kB", "2.4 MB". */
export function bytes(count) {
  if (!Number.isFinite(count)) return t("unknown");
  const units = ["B", "kB", "MB", "GB", "TB"];
  let value = count;
  let unit = 0;
  while (value >= 999.5 && unit < units.length - 1) {
    value /= 1000;
    unit += 1;
  }
  return `${figures(value, 2)} ${units[unit]}`;
}

/** How long ago a moment (ISO text) was: "just now", "5 min ago", "yesterday 14:05", "3 Nov 14:05". */
export function ago(iso, now = Date.now()) {
  const then = new Date(iso);
  const seconds = (now - then.getTime()) / 1000;
  if (!Number.isFinite(seconds)) return "";
  if (seconds < 45) return t("just now");
  if (seconds < 3600) return t`${Math.max(1, Math.round(seconds / 60))} min ago`;
  const clock = then.toLocaleTimeString(locale, { hour: "2-digit", minute: "2-digit", hourCycle: "h23" });
  const days = Math.round((startOfDay(now) - startOfDay(then.getTime())) / 86_400_000);
  if (days === 0) return t`today ${clock}`;
  if (days === 1) return t`yesterday ${clock}`;
  return `${then.toLocaleDateString(locale, { day: "numeric", month: "short" })} ${clock}`;
}

function startOfDay(time) {
  return new Date(time).setHours(0, 0, 0, 0);
}

/** A share of 1 as "42 %"; less than all is never called 100 %. */
export function percent(share) {
  if (!Number.isFinite(share)) return "";
  return `${share >= 1 ? 100 : Math.min(99, Math.max(0, Math.floor(share * 100 + 1e-9)))} %`;
}

/** The same for unfinished work: never "100 %". */
export function percentUnderWay(share) {
  return percent(Math.min(share, 0.99));
}

/** The name of a job: that of its picture's file, without the extension. */
export function jobName({ name }) {
  return name.replace(/(?<=.)\.(png|jpe?g|webp|tiff?|bmp|gif)$/i, "");
}

/** A title within a sentence; German nouns keep their capital letter. */
export function within(title) {
  return language === "en" ? title.toLowerCase() : title;
}

/** With a capital letter. */
export function capital(words) {
  return words.charAt(0).toUpperCase() + words.slice(1);
}

/** A whole number with its thousands separated: 41210 is "41,210" in English; in German that comma would be a decimal point. */
export function thousands(whole) {
  return whole.toLocaleString("en").replaceAll(",", language === "de" ? "\u202f" : ",");
}

/** A unique word: "page-" and 32 digits. */
export function freshKey() {
  const words = crypto.getRandomValues(new Uint32Array(4));
  return `page-${[...words].map((word) => word.toString(16).padStart(8, "0")).join("")}`;
}

/** Words of the server as a sentence: "no such job" is "No such job."; a name at the beginning stays as it is. */
export function sentence(words) {
  const first = /^[a-z]+[ ,:']/.test(words) ? capital(words) : words;
  return /[.!?。]$/.test(first) ? first : first + (language === "ja" ? "。" : ".");
}
