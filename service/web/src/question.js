// The fields of a question, as liftcore declares them: new questions, links, requests and code lines are made of them.
import fields from "../question.json" with { type: "json" }; // of liftcore.query.question: the JSON schema of each field

const FIELDS = Object.entries(fields);
const isList = field => field.type === "array";
const alternatives = field => [field, ...(field.anyOf || [])];

// The default of each field.
export const defaultFields = () => Object.fromEntries(FIELDS.map(([name, field]) => [name, isList(field) ? [] : field.default]));

// The fields that differ from their defaults.
export const changedFields = question => Object.fromEntries(FIELDS.map(([name]) => [name, question[name]])
  .filter(([name, value]) => JSON.stringify(value) !== JSON.stringify(fields[name].default)));

// A query string of values, with a pair for each entry of a list.
export function queryString(values) {
  const pairs = new URLSearchParams();
  for (const [name, value] of Object.entries(values)) for (const entry of [value].flat()) pairs.append(name, entry);
  return pairs;
}

// The fields of several questions for one link: lists joined, other fields with a value for each question.
export function linkFields(questions) {
  const changes = questions.map(changedFields);
  return Object.fromEntries(FIELDS.filter(([name]) => changes.some(fields => name in fields))
    .map(([name]) => [name, questions.flatMap(question => question[name] ?? "")]));
}

// Read the fields of a link for the question at an index; invalid values are left out.
export function readFields(pairs, index) {
  const values = {};
  for (const [name, field] of FIELDS) {
    const texts = pairs.getAll(name);
    const text = texts[index] ?? texts[0];
    const number = text && alternatives(field).some(({ type }) => ["number", "integer"].includes(type)) ? Number(text) : NaN;
    if (isList(field) || text === undefined) continue;
    if (alternatives(field).some(part => part.enum?.includes(text))) values[name] = text;
    else if (Number.isFinite(number)) values[name] = number;
  }
  return values;
}
