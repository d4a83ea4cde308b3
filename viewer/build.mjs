// Builds the page into dist/: the app in parts for a folder or a host, and `single.html`, all of it in one file.
import { createHash } from 'node:crypto'
import { existsSync, mkdirSync, readdirSync, readFileSync, rmSync, writeFileSync } from 'node:fs'
import { dirname, join } from 'node:path'
import { fileURLToPath } from 'node:url'
import { gzipSync } from 'node:zlib'
import { build } from 'esbuild'

const here = dirname(fileURLToPath(import.meta.url))
const dist = join(here, 'dist')
const used = new Set()

const noteInputs = (metafile) => Object.keys(metafile.inputs).forEach((path) => used.add(path))

// The worker's code becomes a text that the page starts from a blob, so that both builds start it in one way.
const workers = {
  name: 'workers',
  setup(builder) {
    builder.onResolve({ filter: /^worker:/ }, (args) => ({
      path: join(dirname(args.importer), args.path.slice('worker:'.length)),
      namespace: 'worker',
    }))
    builder.onLoad({ filter: /.*/, namespace: 'worker' }, async (args) => {
      const made = await build({ ...common, entryPoints: [args.path], format: 'iife', write: false, metafile: true })
      noteInputs(made.metafile)
      return { contents: made.outputFiles[0].text, loader: 'text' }
    })
  },
}

// copc.js asks for a `fetch`, a file system and a decoder of its own: the page gives it bytes and decodes in workers.
const withoutFetch = {
  name: 'without-fetch',
  setup(builder) {
    builder.onResolve({ filter: /^cross-fetch$|^fs$|^path$|^laz-perf$/ }, (args) => ({ path: args.path, namespace: 'empty' }))
    builder.onLoad({ filter: /.*/, namespace: 'empty' }, () => ({ contents: 'module.exports = {}' }))
  },
}

const common = {
  absWorkingDir: here,
  bundle: true,
  minify: true,
  target: 'es2022',
  legalComments: 'none',
  loader: { '.wasm': 'binary', '.svg': 'text' },
  plugins: [workers, withoutFetch],
  logLevel: 'warning',
  metafile: true,
}

const sha256 = (text) => `'sha256-${createHash('sha256').update(text).digest('base64')}'`

function licences() {
  const packages = new Set()
  for (const path of used) {
    const match = path.match(/node_modules\/((?:@[^/]+\/)?[^/]+)\//)
    if (match) packages.add(match[1])
  }
  const parts = ['The page roadscan contains code of these packages.\n']
  for (const name of [...packages].sort()) {
    const folder = join(here, 'node_modules', name)
    const described = JSON.parse(readFileSync(join(folder, 'package.json'), 'utf8'))
    const file = readdirSync(folder).find((one) => /^licen[cs]e/i.test(one))
    const kept = join(here, 'licences', `${name.replace('/', '__')}.txt`)
    const path = file ? join(folder, file) : kept
    if (!existsSync(path)) throw new Error(`${name} ships no licence: add ${kept}`)
    parts.push(`${'='.repeat(100)}\n${name} ${described.version} (${described.license})\n\n${readFileSync(path, 'utf8').trim()}\n`)
  }
  return parts.join('\n')
}

rmSync(dist, { recursive: true, force: true })
mkdirSync(join(dist, 'app'), { recursive: true })

const parts = await build({
  ...common,
  entryPoints: { app: join(here, 'src/main.ts') },
  outdir: join(dist, 'app'),
  format: 'esm',
  splitting: true,
  entryNames: '[name]-[hash]',
  chunkNames: 'part-[hash]',
})
noteInputs(parts.metafile)
const outputs = Object.keys(parts.metafile.outputs).map((path) => path.replace(/^dist\//, ''))
const entry = outputs.find((path) => /app\/app-.*\.js$/.test(path))
const style = outputs.find((path) => /app\/app-.*\.css$/.test(path))

const page = readFileSync(join(here, 'src/index.html'), 'utf8')
const policy = (script, css, connect) =>
  [
    "default-src 'none'",
    `script-src ${script} 'wasm-unsafe-eval'`,
    `style-src ${css}`,
    `img-src ${connect ? "'self' " : ''}blob: data:`,
    ...(connect ? ["connect-src 'self' data: blob:", "font-src 'self'", "manifest-src 'self'"] : []),
    `worker-src ${connect ? "'self' " : ''}blob:`,
    "base-uri 'none'",
    "form-action 'none'",
  ].join('; ')

const fill = (values) => page.replace(/%([A-Z_]+)%/g, (_, key) => values[key])

writeFileSync(
  join(dist, 'index.html'),
  fill({
    POLICY: policy("'self'", "'self'", true),
    STYLE: `<link rel="stylesheet" href="${style}">`,
    SCRIPT: `<script type="module" src="${entry}"></script>`,
    DATA: '',
  }),
)

const whole = await build({
  ...common,
  entryPoints: [join(here, 'src/main.ts')],
  outdir: dist,
  format: 'iife',
  write: false,
  define: { 'import.meta.url': '""' },
})
const text = (ending) => whole.outputFiles.find((file) => file.path.endsWith(ending)).text
const script = text('.js').replaceAll('</script', '<\\/script').replaceAll('<!--', '<\\!--')
const css = text('.css')
writeFileSync(
  join(dist, 'single.html'),
  fill({
    POLICY: policy(sha256(script), sha256(css), false),
    STYLE: `<style>${css}</style>`,
    SCRIPT: `<script>${script}</script>`,
    DATA: '<!--roadscan-data-->',
  }),
)
writeFileSync(join(dist, 'app/LICENSES.txt'), licences())

const zipped = (path) => gzipSync(readFileSync(join(dist, path)), { level: 9 }).length
const sizes = ['index.html', ...outputs].map((path) => [path, zipped(path)])
for (const [path, bytes] of sizes) console.log(`${path.padEnd(32)} ${(bytes / 1e3).toFixed(1).padStart(8)} kB gzipped`)
const all = sizes.reduce((sum, [, bytes]) => sum + bytes, 0)
console.log(`${'in all'.padEnd(32)} ${(all / 1e3).toFixed(1).padStart(8)} kB gzipped`)
if (all > 1e6) throw new Error('the page is larger than 1 MB gzipped')
