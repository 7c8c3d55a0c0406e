/** Which machine a job is for: the mills of this server first, by their own names. */

import { t } from "../lib/language.js";

const HERE = t("Mills of this server");
const OTHERS = t("Other machines");

/** The field of the machine with a choice for each profile: [name, words, description, group]. */
export function withProfiles(field, profiles) {
  if (field.key !== "machine.profile" || !profiles.length) return field;
  const [here, others] = [profiles.filter(isHere), profiles.filter((profile) => !isHere(profile))];
  const choice = (group) => (profile) => [profile.name, words(profile), profile.description, here.length ? group : undefined];
  return { ...field, choices: [...here.map(choice(HERE)), ...others.map(choice(OTHERS))] };
}

/** The profile for a new job: that of the only mill, a real one before a simulated one; otherwise the default. */
export function firstProfile(profiles, usual) {
  const real = profiles.filter(({ mills }) => mills?.some(({ simulated }) => !simulated));
  const here = real.length ? real : profiles.filter(isHere);
  return here.length && !here.some(({ name }) => name === usual) ? here[0].name : usual;
}

function isHere({ mills }) {
  return mills?.length > 0;
}

/** "simulated (grbl)", "shop" for a mill with a profile of its own, "grbl: desktop router". */
function words(profile) {
  if (!isHere(profile)) return `${profile.name}: ${profile.description.split(/[,;、]/)[0]}`;
  const names = profile.mills.map(({ name }) => name).join(", ");
  return profile.mills.some(({ name }) => name === profile.name) ? names : `${names} (${profile.name})`;
}
