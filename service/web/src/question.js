// A question as liftcore declares it: fresh ones, links, requests and lines of code are made of its fields.
import fields from "./question.json"; // of liftcore.query.question: the JSON schema of each

const FIELDS = Object.entries(fields);
const isList = field => field.type === "array";
const parts = field => [field, ...(field.anyOf || [])];

export const notation = fields.like.items.anyOf[0]; // of an example

// Each field as it is without being asked for.
export const blank = () => Object.fromEntries(FIELDS.map(([name, field]) => [name, isList(field) ? [] : field.default]));

// The fields that are not.
export const asked = question => Object.fromEntries(FIELDS.map(([name]) => [name, question[name]])
  .filter(([name, value]) => JSON.stringify(value) !== JSON.stringify(fields[name].default)));

// Values as a query string has them, those of lists one by one.
export function search(values) {
  const pairs = new URLSearchParams();
  for (const [name, value] of Object.entries(values)) for (const one of [value].flat()) pairs.append(name, one);
  return pairs;
}

// Several questions in one link, where fields that are no lists have a value for each of them.
export function linked(questions) {
  const changes = questions.map(asked);
  return Object.fromEntries(FIELDS.filter(([name]) => changes.some(fields => name in fields))
    .map(([name]) => [name, questions.flatMap(question => question[name] ?? "")]));
}

// Such values for the question at a place; what a field does not take is left out.
export function read(pairs, place) {
  const values = {};
  for (const [name, field] of FIELDS) {
    const texts = [name, ...(field.old_names || [])].map(key => pairs.getAll(key)).find(list => list.length) ?? []; // a link may be old
    const text = texts[place] ?? texts[0];
    const number = text && parts(field).some(({ type }) => ["number", "integer"].includes(type)) ? Number(text) : NaN;
    if (isList(field) || text === undefined) continue;
    if (parts(field).some(part => part.enum?.includes(text))) values[name] = text;
    else if (Number.isFinite(number)) values[name] = number;
  }
  return values;
}
