/** A picture on its way from where it was dropped to the view of a new job, and a job that is not sent yet. */

let waiting = null;
let draft = null;

/** Keeps a file for the view of a new job. */
export function keep(file) {
  waiting = file;
}

/** The file that was kept, once. */
export function take() {
  const file = waiting;
  waiting = null;
  return file;
}

/** Keeps what a person has set, while they look at something else; null: nothing. */
export function keepDraft(made) {
  draft = made;
}

/** {picture, edits, name, spec} as it was kept, once. */
export function takeDraft() {
  const made = draft;
  draft = null;
  return made;
}
