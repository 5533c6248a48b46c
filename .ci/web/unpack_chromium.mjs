// Unpacks the Chromium of the package @sparticuz/chromium: node unpack_chromium.mjs PACKAGES DIRECTORY
// The browser itself, its SwiftShader (WebGL without a GPU), and libraries and fonts for machines that have none.
import { execFileSync } from "node:child_process";
import { createReadStream, createWriteStream, mkdirSync, renameSync, rmSync, writeFileSync } from "node:fs";
import { join, resolve } from "node:path";
import { pipeline } from "node:stream/promises";
import { createBrotliDecompress } from "node:zlib";

const [packages, target] = process.argv.slice(2);
const source = join(packages, "@sparticuz", "chromium", "bin");
const draft = `${target}.draft`;
rmSync(draft, { recursive: true, force: true });
mkdirSync(draft, { recursive: true });

const unpack = (from, to, mode) =>
  pipeline(createReadStream(join(source, from)), createBrotliDecompress(), createWriteStream(join(draft, to), { mode }));

await unpack("chromium.br", "chromium", 0o755);
for (const name of ["swiftshader", "al2023", "fonts"]) {
  await unpack(`${name}.tar.br`, `${name}.tar`);
  execFileSync("tar", ["-xf", join(draft, `${name}.tar`), "-C", draft]);
  rmSync(join(draft, `${name}.tar`));
}
// Its own names folders of another machine.
const folders = [join(resolve(target), "fonts"), "/usr/share/fonts", "/usr/local/share/fonts"];
writeFileSync(
  join(draft, "fonts.conf"),
  `<?xml version="1.0"?><!DOCTYPE fontconfig SYSTEM "fonts.dtd"><fontconfig>${folders.map((folder) => `<dir>${folder}</dir>`).join("")}` +
    `<cachedir>${join(resolve(target), "font-cache")}</cachedir></fontconfig>\n`,
);
rmSync(target, { recursive: true, force: true });
renameSync(draft, target);
