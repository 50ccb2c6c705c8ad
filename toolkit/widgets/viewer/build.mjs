// Bundles src/webgl.js and all that it uses into dist/viewer.js, and the licences of what it uses into dist/LICENSES.txt.
import { mkdir, readFile, readdir, rename, writeFile } from "node:fs/promises";
import { dirname, join } from "node:path";
import { fileURLToPath } from "node:url";

import { build } from "esbuild";

const here = dirname(fileURLToPath(import.meta.url));
process.chdir(here);

const { metafile, outputFiles } = await build({
  entryPoints: ["src/webgl.js"],
  bundle: true,
  format: "esm",
  minify: true,
  target: "es2022",
  legalComments: "inline",
  metafile: true,
  write: false,
  outfile: "dist/viewer.js",
  logLevel: "warning",
});

// The folders of the packages of which something is in the bundle.
function packagesOf(inputs) {
  const folders = Object.keys(inputs)
    .map((path) => path.match(/^(?:.*\/)?node_modules\/(?:@[^/]+\/)?[^/]+/)?.[0])
    .filter(Boolean);
  return [...new Set(folders)].sort();
}

async function licenceOf(folder) {
  const { name, version, license } = JSON.parse(await readFile(join(folder, "package.json"), "utf8"));
  const files = (await readdir(folder)).filter((file) => /^(licen[cs]e|copying|notice)/i.test(file)).sort();
  if (!files.length) throw new Error(`${name} ${version} (${license}) brings no licence file`);
  const texts = await Promise.all(files.map((file) => readFile(join(folder, file), "utf8")));
  return `${name} ${version} (${license})\n\n${texts.map((text) => text.trim()).join("\n\n")}\n`;
}

const packages = packagesOf(metafile.inputs);
const licences = await Promise.all(packages.map(licenceOf));
await mkdir("dist", { recursive: true });
await writeFile("dist/LICENSES.txt", `viewer.js contains:\n\n${licences.join(`\n${"-".repeat(80)}\n\n`)}`);
// The bundle last and in one step: where it is there, everything is.
await writeFile("dist/viewer.js.tmp", outputFiles[0].contents);
await rename("dist/viewer.js.tmp", "dist/viewer.js");
console.log(`dist/viewer.js: ${(outputFiles[0].contents.length / 1e6).toFixed(2)} MB, with ${packages.length} packages`);
