/** A job spec as a tree of plain values, reached by dotted keys. */

/** The value at "optics.light.kind"; undefined if there is none. */
export function valueAt(spec, key) {
  return key.split(".").reduce((tree, step) => tree?.[step], spec);
}

/** Set the value there and make missing tables on the path; undefined deletes it, and tables that become empty. */
export function put(spec, key, value) {
  const [first, ...rest] = key.split(".");
  if (!rest.length) {
    if (value === undefined) delete spec[first];
    else spec[first] = value;
    return spec;
  }
  const table = spec[first] ?? {};
  put(table, rest.join("."), value);
  if (Object.keys(table).length) spec[first] = table;
  else delete spec[first];
  return spec;
}

/** A spec with a change taken; passes that were given make way for recommended ones. */
export function withChange(spec, values) {
  const result = structuredClone(spec);
  if (values.preset) delete result.passes;
  for (const [key, value] of Object.entries(values)) put(result, key, value);
  return result;
}

/** Two trees as one; where both say something, the second counts. Lists are replaced whole. */
export function merged(under, over) {
  const result = { ...under };
  for (const [key, value] of Object.entries(over ?? {})) {
    result[key] = isTable(value) && isTable(result[key]) ? merged(result[key], value) : structuredClone(value);
  }
  return result;
}

export function isTable(value) {
  return value !== null && typeof value === "object" && !Array.isArray(value);
}

export function same(one, other) {
  return JSON.stringify(one) === JSON.stringify(other);
}

/** The text of a number as people type it: "12,5" is 12.5. NaN if it is not a number. */
export function numberOf(text) {
  const plain = text.trim().replace(",", ".");
  return /^[-+]?(\d+\.?\d*|\.\d+)(e[-+]?\d+)?$/i.test(plain) ? Number(plain) : NaN;
}
