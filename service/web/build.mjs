// Builds the page: `make web`. One script, one style, one document and the licences of what is in them, in built/,
// each with the digest of the sources (src, this file, the lock), which a test compares.
import { createHash } from "node:crypto";
import { mkdirSync, readdirSync, readFileSync, writeFileSync } from "node:fs";
import { build } from "esbuild";

const here = new URL(".", import.meta.url);
const read = name => readFileSync(new URL(name, here), "utf-8");
const sources = [...readdirSync(new URL("src", here)).map(name => `src/${name}`), "build.mjs", "package-lock.json"].sort();
const hash = createHash("sha256");
for (const name of sources) hash.update(`${name}\0${read(name)}\0`);
const digest = hash.digest("hex");

const common = { absWorkingDir: here.pathname, bundle: true, minify: true, write: false, legalComments: "none", logLevel: "warning", loader: { ".woff2": "dataurl" } };
const [script, style] = await Promise.all([
  build({ ...common, entryPoints: ["src/main.js"], format: "esm", target: "es2022" }),
  build({ ...common, entryPoints: ["src/page.css"] }),
]);
const banner = `/* splatlift's page, sources sha256:${digest}; licences in LICENSES.txt */\n`;
const bundled = ["three", "@sparkjsdev/spark", "fflate", "@fontsource-variable/inter"];
const licences = bundled.map(name => {
  const { version, license } = JSON.parse(read(`node_modules/${name}/package.json`));
  return `${name} ${version} (${license})\n\n${read(`node_modules/${name}/LICENSE`).trim()}\n`;
});
mkdirSync(new URL("built", here), { recursive: true });
const write = (name, text) => writeFileSync(new URL(`built/${name}`, here), text);
write("page.js", banner + script.outputFiles[0].text);
write("page.css", banner + style.outputFiles[0].text);
write("page.html", read("src/index.html").replaceAll("{digest}", digest.slice(0, 16)));
write("LICENSES.txt", `page.js and page.css hold these libraries and this font.\n\n${licences.join("\n\n")}`);
console.log(`built ${(script.outputFiles[0].contents.length / 1e6).toFixed(1)} MB of ${sources.length} sources, ${digest.slice(0, 16)}`);
