'use strict';
// Drives the coordinator's page in headless Chromium against real processes: a job whose image fills,
// 100 more jobs and 500 workers, two widths, pause and cancel, and a restart of the coordinator.
// Screenshots lie in --out. Exit code 77: Chromium or puppeteer-core is missing.

const assert = require('node:assert/strict');
const {execFileSync, spawn} = require('node:child_process');
const fs = require('node:fs');
const os = require('node:os');
const path = require('node:path');

const options = {};
for (let i = 2; i + 1 < process.argv.length; i += 2) options[process.argv[i].slice(2)] = process.argv[i + 1];

const chromium = ['/usr/bin/chromium', '/usr/bin/chromium-browser'].find((file) => fs.existsSync(file));
const modules = path.join(options.modules, 'puppeteer-core');
if (!chromium || !fs.existsSync(modules)) {
  console.log('skipped: FARPOINT_BROWSER_TEST=1 ./dev test installs Chromium and puppeteer-core');
  process.exit(77);
}
const puppeteer = require(modules);

const folder = fs.mkdtempSync(path.join(os.tmpdir(), 'farpoint-page-'));
const processes = [];
const program = (name) => path.join(options.bin, name);

function start(name, args) {
  const child = spawn(program(name), args, {stdio: ['ignore', 'pipe', 'ignore']});
  processes.push(child);
  return child;
}

// The ports that a coordinator says it listens on.
async function startServer(listen, web) {
  const child = start('farpoint-server', ['--listen', listen, '--web', web, '--store', path.join(folder, 'store')]);
  let text = '';
  for await (const data of child.stdout) {
    text += data;
    const api = /listening on 127\.0\.0\.1:(\d+)/.exec(text);
    const page = /web on http:\/\/127\.0\.0\.1:(\d+)/.exec(text);
    if (api && page) return {child, api: `127.0.0.1:${api[1]}`, web: `127.0.0.1:${page[1]}`};
  }
  throw new Error(`the coordinator did not start: ${text}`);
}

function submit(api, args) {
  execFileSync(program('farpoint'), ['submit', path.join(options.scenes, 'cornell.gltf'), ...args,
                                     '--detach', '--coordinator', api], {stdio: 'ignore'});
}

async function main() {
  fs.mkdirSync(options.out, {recursive: true});
  let server = await startServer('127.0.0.1:0', '127.0.0.1:0');
  submit(server.api, ['--resolution', '512x512', '--tile', '64', '--title', 'Cornell box']);
  start('farpoint-worker', ['--coordinator', server.api, '--cache', path.join(folder, 'cache'), '--name', 'real']);

  const browser = await puppeteer.launch(
      {executablePath: chromium, args: ['--no-sandbox', '--disable-gpu'], userDataDir: path.join(folder, 'browser')});
  try {
    const page = await browser.newPage();
    const errors = [];
    page.on('pageerror', (error) => errors.push(error.message));
    page.on('console', (line) => {
      // A coordinator that is away is reported by the browser, too.
      if (line.type() === 'error' && !/ERR_CONNECTION|ERR_EMPTY|Failed to load resource/.test(line.text())) {
        errors.push(line.text());
      }
    });
    const foreign = [];
    page.on('request', (request) => {
      const url = request.url();
      if (!url.startsWith(`http://${server.web}/`) && !/^(data|blob):/.test(url)) foreign.push(url);
    });
    const shot = (name) => page.screenshot({path: path.join(options.out, `${name}.png`), fullPage: true});
    const until = (check, ...args) => page.waitForFunction(check, {timeout: 90000, polling: 200}, ...args);

    await page.setViewport({width: 1280, height: 900});
    await page.goto(`http://${server.web}/`);
    await until(() => document.querySelectorAll('#jobs li').length === 1);
    await page.click('#jobs a');
    // Filling: something is drawn while something is not.
    const drawn = () => {
      const canvas = document.getElementById('canvas');
      if (canvas.width < 2) return 0;
      const {data} = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height);
      let count = 0;
      for (let i = 3; i < data.length; i += 4) count += data[i] > 0;
      return count / (canvas.width * canvas.height);
    };
    await page.evaluate(`window.drawn = ${drawn}`);
    await until(() => window.drawn() > 0.1);
    await shot('filling-1280');
    await until(() => document.querySelector('#job-facts dd').textContent === 'done');
    await until(() => window.drawn() > 0.999);
    await shot('image-1280');

    // Every heat map has a range of colours, but for the cuts that rays do without.
    for (const layer of ['seconds', 'clusters']) {
      await page.select('#layer', layer);
      const colours = await page.evaluate(() => {
        const canvas = document.getElementById('canvas');
        const {data} = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height);
        const seen = new Set();
        for (let i = 0; i < data.length; i += 4) seen.add(data[i] << 16 | data[i + 1] << 8 | data[i + 2]);
        return seen.size;
      });
      assert.ok(colours > 4, `${layer}: ${colours} colours`);
      await shot(`${layer}-1280`);
    }
    await page.select('#layer', 'image');

    execFileSync(options.crowd, [server.api, '100', '500']);
    await until(() => document.querySelectorAll('#jobs li').length === 101);
    await until(() => document.querySelectorAll('#workers tr').length === 501);
    await shot('crowd-1280');
    // No panel lies over another one or sticks out.
    const fits = () => {
      const boxes = [...document.querySelectorAll('section:not([hidden])')].map((node) => node.getBoundingClientRect());
      const apart = (a, b) => a.right <= b.left || b.right <= a.left || a.bottom <= b.top || b.bottom <= a.top;
      return boxes.length > 1 && boxes.every((a, i) => boxes.slice(i + 1).every((b) => apart(a, b))) &&
          document.documentElement.scrollWidth <= window.innerWidth;
    };
    assert.ok(await page.evaluate(fits), 'the panels fit at 1280 pixels');
    await page.setViewport({width: 400, height: 800});
    await shot('crowd-400');
    assert.ok(await page.evaluate(fits), 'the panels fit at 400 pixels');
    await page.goto(`http://${server.web}/#`);
    await until(() => document.getElementById('job-panel').hidden);
    await shot('overview-400');
    await page.setViewport({width: 1280, height: 900});
    await shot('overview-1280');

    // A job of the crowd: resumed it would fail, so it is cancelled.
    await page.type('#job-filter', 'shot 42 ');
    await until(() => document.querySelectorAll('#jobs li').length === 1);
    await page.click('#jobs a');
    await until(() => document.querySelector('#job-facts dd')?.textContent === 'paused');
    page.on('dialog', (dialog) => dialog.accept());
    await page.click('button[data-key="cancel"]');
    await until(() => document.querySelector('#job-facts dd').textContent === 'cancelled');

    // The coordinator dies and comes back on the same ports and store.
    server.child.kill('SIGKILL');
    await until(() => document.getElementById('connection').dataset.state === 'lost');
    await shot('lost-1280');
    server = await startServer(server.api, server.web);
    await until(() => document.getElementById('connection').dataset.state === 'ok');
    await until(() => document.querySelector('#job-facts dd').textContent === 'cancelled');
    assert.deepEqual(errors, []);
    assert.deepEqual(foreign, []);
  } finally {
    await browser.close();
  }
}

main().then(() => 0, (error) => {
  console.error(error);
  return 1;
}).then((code) => {
  for (const child of processes) child.kill('SIGKILL');
  fs.rmSync(folder, {recursive: true, force: true, maxRetries: 5});
  process.exit(code);
});
