'use strict';
// The page of the coordinator: asks for JSON every two seconds and draws it. docs/web.md.

const kPeriodMs = 2000;
const kMaxCanvasPx = 1600;  // larger images are shown at a whole fraction of their size
const kFetches = 4;         // tiles at a time
const kDash = '–';

const byId = (id) => document.getElementById(id);

function element(tag, properties, ...children) {
  const node = Object.assign(document.createElement(tag), properties);
  node.append(...children);
  return node;
}

function duration(seconds) {
  if (seconds === undefined || seconds === null) return kDash;
  const s = Math.round(seconds);
  if (s < 60) return `${s} s`;
  if (s < 3600) return `${Math.floor(s / 60)} min ${s % 60} s`;
  return `${Math.floor(s / 3600)} h ${Math.floor((s % 3600) / 60)} min`;
}

function compact(value) {
  return value >= 1000 ? value.toLocaleString('en', {maximumFractionDigits: 0}) : +value.toPrecision(3);
}

function counted(count, noun) {
  return `${compact(count)} ${noun}${count === 1 ? '' : 's'}`;
}

// --- The coordinator ---

class Refused extends Error {
  constructor(status, text) {
    super(text);
    this.status = status;
  }
}

async function request(path, options = {}) {
  const headers = {'X-Farpoint': '1'};
  const token = sessionStorage.getItem('farpoint-token');
  if (token) headers.Authorization = `Bearer ${token}`;
  const response = await fetch(path, {...options, headers, signal: AbortSignal.timeout(10000)});
  if (response.ok) return response;
  let text = `HTTP ${response.status}`;
  try {
    text = (await response.json()).error || text;
  } catch {
    // No JSON: somebody else answered.
  }
  throw new Refused(response.status, text);
}

function connection(state, text) {
  byId('connection').dataset.state = state;
  byId('connection').textContent = text;
}

function message(text) {
  byId('message').hidden = !text;
  byId('message').textContent = text || '';
}

// --- Jobs and workers ---

let overview = null;

function matches(filter, ...texts) {
  const wanted = filter.trim().toLowerCase();
  return wanted === '' || texts.some((text) => (text || '').toLowerCase().includes(wanted));
}

// Children of `list` by key, made, updated, ordered and removed as `items` say.
function sync(list, items, key, make, update) {
  const old = new Map([...list.children].map((node) => [node.dataset.key, node]));
  let at = list.firstElementChild;
  for (const item of items) {
    let node = old.get(key(item));
    if (!node) {
      node = make(item);
      node.dataset.key = key(item);
    }
    old.delete(key(item));
    update(node, item);
    if (node === at) {
      at = at.nextElementSibling;
    } else {
      list.insertBefore(node, at);
    }
  }
  for (const node of old.values()) node.remove();
}

function showJobs() {
  const active = (job) => !['done', 'failed', 'cancelled'].includes(job.state);
  // What is in work, what waits, what somebody holds, what has ended; the newest first.
  const ranks = ['rendering', 'baking', 'queued', 'paused'];
  const rank = (job) => active(job) ? ranks.indexOf(job.state) : ranks.length;
  const filter = byId('job-filter').value;
  const jobs = overview.jobs.filter((job) => matches(filter, job.id, job.title, job.state, job.owner));
  jobs.reverse();
  jobs.sort((a, b) => rank(a) - rank(b));
  sync(byId('jobs'), jobs, (job) => job.id, () => {
    const link = element('a', {}, element('span', {className: 'name'}), element('span', {className: 'eta'}),
                         element('progress', {max: 1}), element('span', {className: 'state'}),
                         element('span', {className: 'state'}));
    return element('li', {}, link);
  }, (node, job) => {
    const link = node.firstElementChild;
    const [name, eta, bar, state, tiles] = link.children;
    node.className = job.state;
    link.href = `#${job.id}`;
    if (job.id === current.id) {
      link.setAttribute('aria-current', 'true');
    } else {
      link.removeAttribute('aria-current');
    }
    name.textContent = job.title || job.id;
    eta.textContent = active(job) && job.eta_s !== undefined ? duration(job.eta_s) : '';
    bar.value = job.progress;
    state.className = `state ${job.state}`;
    state.textContent = `${job.state} ${Math.floor(100 * job.progress)} %`;
    tiles.textContent = `${job.tiles.committed}/${job.tiles.total}`;
  });
}

function showWorkers() {
  const filter = byId('worker-filter').value;
  const workers = overview.workers.filter((worker) => matches(filter, worker.name, worker.id));
  workers.sort((a, b) => a.name.localeCompare(b.name, 'en', {numeric: true}));
  sync(byId('workers'), workers, (worker) => worker.id,
       () => element('tr', {}, ...Array.from({length: 5}, () => element('td'))),
       (row, worker) => {
         const state = worker.gone ? 'gone' : worker.set_aside ? 'set aside' : worker.leases > 0 ? 'busy' : 'idle';
         const texts = [worker.name || worker.id, worker.threads, worker.committed, worker.failures,
                        worker.idle_s > 5 ? `${state}, silent ${duration(worker.idle_s)}` : state];
         texts.forEach((text, i) => {
           if (row.cells[i].textContent !== String(text)) row.cells[i].textContent = text;
         });
       });
}

function showOverview() {
  const busy = overview.workers.filter((worker) => worker.leases > 0).length;
  const queued = overview.jobs.filter((job) => ['queued', 'baking', 'rendering'].includes(job.state))
                     .reduce((sum, job) => sum + job.tiles.queued, 0);
  byId('summary').textContent =
      `${counted(overview.jobs.length, 'job')} · ${counted(overview.workers.length, 'worker')}, ${busy} busy · ` +
      `${counted(queued, 'tile')} queued · ${overview.version}` +
      (overview.caller ? ` · ${overview.caller} (${overview.role})` : '');
  showJobs();
  showWorkers();
}

// --- One job ---

// What is shown of the job that the address names. `drawn`: tiles that are on `image`.
const current = {id: '', view: null, image: null, drawn: new Set(), fetching: 0, generation: 0};

function select() {
  const id = decodeURIComponent(location.hash.slice(1));
  if (id === current.id) return;
  Object.assign(current, {id, view: null});
  forgetPixels();
  byId('frame').value = 0;
  byId('job-panel').hidden = true;
  byId('main').classList.toggle('with-job', id !== '');
  if (overview) showJobs();
  update();
}

function forgetPixels() {
  current.image = null;
  current.drawn = new Set();
  ++current.generation;
}

const kActions = {
  pause: {text: 'Pause', when: (s) => ['queued', 'baking', 'rendering'].includes(s)},
  resume: {text: 'Resume', when: (s) => s === 'paused'},
  cancel: {text: 'Cancel', when: (s) => !['done', 'failed', 'cancelled'].includes(s),
           ask: 'Cancel this job? Its tiles stay, and a requeue goes on where it was.'},
  requeue: {text: 'Requeue', when: (s) => ['failed', 'cancelled'].includes(s)},
  'requeue-all': {text: 'Render again', when: (s) => ['done', 'failed', 'cancelled'].includes(s),
                  ask: 'Render all tiles of this job again?'},
};

async function act(action) {
  if (kActions[action].ask && !confirm(kActions[action].ask)) return;
  try {
    await request(`/api/jobs/${encodeURIComponent(current.id)}/${action}`, {method: 'POST'});
    if (action === 'requeue-all') forgetPixels();
    message('');
  } catch (error) {
    message(error.message);
  }
  update();
}

function showActions(state) {
  sync(byId('job-actions'), Object.keys(kActions).filter((name) => kActions[name].when(state)), (name) => name,
       (name) => {
         const button = element('button', {type: 'button', textContent: kActions[name].text});
         button.addEventListener('click', () => act(name));
         return button;
       }, () => {});
}

function showFacts(job) {
  const {tiles, frames} = job;
  const facts = {
    state: job.state,
    left: job.eta_s ? duration(job.eta_s) : kDash,
    tiles: `${tiles.committed} of ${tiles.total}, ${tiles.leased} in work, ${tiles.queued} queued` +
        (tiles.failed ? `, ${tiles.failed} failed` : ''),
    priority: job.priority,
    submitted: new Date(job.submitted_unix_ms).toLocaleString(),
    id: job.id,
  };
  if (frames.total > 1) facts.frames = `${frames.done} done, ${frames.baked} baked of ${frames.total}`;
  if (job.owner) facts.owner = job.owner;
  if (job.reissued) facts['leases lost'] = job.reissued;
  if (job.refused_results) facts.refused = job.refused_results;
  sync(byId('job-facts'), Object.entries(facts), ([name]) => name,
       ([name]) => element('div', {}, element('dt', {textContent: name}), element('dd')),
       (node, [, value]) => { node.lastElementChild.textContent = value; });
}

function showLog(log) {
  const list = byId('log');
  list.replaceChildren(...[...log].reverse().map((line) => {
    const about = [line.tile !== undefined ? `tile ${line.tile}` : '', line.attempt ? `attempt ${line.attempt}` : '',
                   line.worker || ''].filter((text) => text).join(', ');
    const time = element('time', {textContent: line.unix_ms ? new Date(line.unix_ms).toLocaleTimeString() : kDash});
    return element('li', {className: line.level}, time, `${line.text}${about ? ` (${about})` : ''}`);
  }));
  if (log.length === 0) list.append(element('li', {textContent: 'nothing out of the ordinary'}));
}

// --- The picture ---

// Full pixels of the image to one of the canvas.
function shrinkOf(view) {
  const [x0, y0, x1, y1] = view.crop;
  return Math.min(64, Math.max(1, Math.ceil(Math.max(x1 - x0, y1 - y0) / kMaxCanvasPx)));
}

function placeOf(view, tile) {
  const shrink = shrinkOf(view);
  const x = (tile.rect[0] - view.crop[0]) / shrink;
  const y = (tile.rect[1] - view.crop[1]) / shrink;
  return [x, y, (tile.rect[2] - tile.rect[0]) / shrink, (tile.rect[3] - tile.rect[1]) / shrink];
}

// Black over violet and orange to white, by eight corners.
const kRamp = [[0, 0, 4], [40, 11, 84], [101, 21, 110], [159, 42, 99], [212, 72, 66], [245, 125, 21],
               [250, 193, 39], [252, 255, 164]];
function heat(t) {
  const at = Math.min(Math.max(t, 0), 1) * (kRamp.length - 1);
  const i = Math.min(Math.floor(at), kRamp.length - 2);
  const c = kRamp[i].map((v, k) => Math.round(v + (at - i) * (kRamp[i + 1][k] - v)));
  return `rgb(${c.join(' ')})`;
}

const kStates = {queued: '#2a313c', leased: '#e3b341', committed: '#58c48b', failed: '#ff7b72'};
const kUnits = {seconds: 'thread-seconds', clusters: 'clusters', cut_nodes: 'nodes in all cuts'};

function draw() {
  const {view} = current;
  if (!view) return;
  const shrink = shrinkOf(view);
  const [x0, y0, x1, y1] = view.crop;
  const canvas = byId('canvas');
  const width = Math.ceil((x1 - x0) / shrink), height = Math.ceil((y1 - y0) / shrink);
  if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, {width, height});
  if (!current.image) current.image = new OffscreenCanvas(width, height);
  const context = canvas.getContext('2d');
  const layer = byId('layer').value;
  context.clearRect(0, 0, width, height);
  if (layer === 'image') {
    context.drawImage(current.image, 0, 0);
    byId('legend').textContent = '';
  } else if (layer === 'state') {
    for (const tile of view.tiles) {
      context.fillStyle = kStates[tile.state];
      context.fillRect(...placeOf(view, tile));
    }
    byId('legend').textContent = 'grey: queued · amber: in work · green: done · red: failed';
  } else {
    // By area, so that tiles at the edges compare.
    const perPixel = (tile) => tile[layer] / ((tile.rect[2] - tile.rect[0]) * (tile.rect[3] - tile.rect[1]));
    const known = view.tiles.filter((tile) => tile[layer] !== undefined);
    const most = Math.max(...known.map(perPixel), 0);
    for (const tile of known) {
      context.fillStyle = heat(most > 0 ? perPixel(tile) / most : 0);
      context.fillRect(...placeOf(view, tile));
    }
    const values = known.map((tile) => tile[layer]);
    byId('legend').textContent = known.length === 0 ?
        `no finished tile has ${kUnits[layer]}` :
        `${kUnits[layer]} per pixel, black: none, white: the most; tiles have ` +
            `${compact(Math.min(...values))} to ${compact(Math.max(...values))}`;
  }
  context.lineWidth = 2;
  context.strokeStyle = kStates.leased;
  for (const tile of view.tiles) {
    if (tile.state !== 'leased') continue;
    const [x, y, w, h] = placeOf(view, tile);
    context.strokeRect(x + 1, y + 1, w - 2, h - 2);
  }
}

// Fetches the pixels of tiles that are done and not drawn yet, some at a time.
async function fetchTiles() {
  const {view, generation} = current;
  if (!view || byId('layer').value !== 'image' || current.fetching >= kFetches) return;
  const shrink = shrinkOf(view);
  const stops = Math.round(Number(byId('stops').value)) || 0;
  ++current.fetching;
  try {
    for (let i = 0; i < view.tiles.length && current.generation === generation; ++i) {
      const tile = view.tiles[i];
      if (tile.state !== 'committed' || current.drawn.has(i)) continue;
      current.drawn.add(i);
      try {
        const path = `/api/jobs/${encodeURIComponent(view.job.id)}/tiles/${view.first_tile + i}.png`;
        const response = await request(`${path}?shrink=${shrink}&stops=${stops}`);
        const bitmap = await createImageBitmap(await response.blob());
        if (current.generation !== generation) return;
        if (!current.image) draw();
        const [x, y] = placeOf(view, tile);
        current.image.getContext('2d').drawImage(bitmap, x, y);
        bitmap.close();
        draw();
      } catch (error) {
        current.drawn.delete(i);
        if (error instanceof Refused && error.status === 409) byId('legend').textContent = error.message;
        return;  // the next update tries again
      }
    }
  } finally {
    --current.fetching;
  }
}

function showTileAt(event) {
  const {view} = current;
  if (!view) return;
  const canvas = byId('canvas');
  const box = canvas.getBoundingClientRect();
  const shrink = shrinkOf(view);
  const x = view.crop[0] + (event.clientX - box.left) / box.width * canvas.width * shrink;
  const y = view.crop[1] + (event.clientY - box.top) / box.height * canvas.height * shrink;
  const i = view.tiles.findIndex(({rect}) => x >= rect[0] && x < rect[2] && y >= rect[1] && y < rect[3]);
  if (i < 0) return;
  const tile = view.tiles[i];
  const parts = [`tile ${view.first_tile + i}: ${tile.state}`];
  if (tile.seconds !== undefined) parts.push(`${compact(tile.seconds)} thread-s`);
  if (tile.clusters !== undefined) parts.push(`${compact(tile.clusters)} clusters`);
  if (tile.cut_nodes !== undefined) parts.push(`${compact(tile.cut_nodes)} nodes in cuts`);
  if (tile.fraction !== undefined) parts.push(`${Math.round(100 * tile.fraction)} %`);
  if (tile.failures) parts.push(`failed ${tile.failures} times`);
  if (tile.worker) parts.push(tile.worker);
  byId('tile-facts').textContent = parts.join(' · ');
}

async function updateJob() {
  const {id} = current;
  if (!id) return;
  const frame = Math.max(0, Math.floor(Number(byId('frame').value)) || 0);
  let view;
  try {
    view = await (await request(`/api/jobs/${encodeURIComponent(id)}?frame=${frame}`)).json();
  } catch (error) {
    if (error instanceof Refused && ![401, 503].includes(error.status)) {
      message(error.message);
      return;
    }
    throw error;
  }
  const why = await (await request(`/api/jobs/${encodeURIComponent(id)}/explain`)).json();
  if (current.id !== id) return;
  if (current.view && current.view.frame_index !== view.frame_index) forgetPixels();
  // A tile that was done and is not any more was rendered wrong, or the job was requeued.
  for (const i of current.drawn) {
    if (view.tiles[i] && view.tiles[i].state !== 'committed') {
      forgetPixels();
      break;
    }
  }
  current.view = view;
  const {job} = view;
  byId('job-panel').hidden = false;
  byId('job-panel').className = job.state;
  byId('job-title').textContent = job.title || job.id;
  byId('job-progress').value = job.progress;
  byId('job-error').hidden = !job.error;
  byId('job-error').textContent = job.error || '';
  byId('frame-label').hidden = job.frames.total < 2;
  byId('frame').max = job.frames.total - 1;
  byId('why').replaceChildren(...why.lines.map((line) => element('li', {textContent: line})));
  showActions(job.state);
  showFacts(job);
  showLog(view.log);
  draw();
  for (let i = 0; i < kFetches; ++i) fetchTiles();
}

// --- The loop ---

let timer = 0;
let updating = false;
let again = false;

async function update() {
  clearTimeout(timer);
  if (updating) {
    again = true;
    return;
  }
  updating = true;
  try {
    overview = await (await request('/api/overview')).json();
    byId('login').hidden = true;
    byId('main').hidden = false;
    byId('forget').hidden = !sessionStorage.getItem('farpoint-token');
    showOverview();
    await updateJob();
    connection('ok', overview.draining ? 'connected, shutting down' : 'connected');
  } catch (error) {
    if (error instanceof Refused && error.status === 401) {
      connection('lost', 'token needed');
      if (sessionStorage.getItem('farpoint-token')) message(error.message);
      sessionStorage.removeItem('farpoint-token');
      byId('main').hidden = true;
      byId('login').hidden = false;
      updating = false;
      return;  // until somebody enters one
    }
    connection('lost', error instanceof Refused ? error.message : 'connection lost, trying again');
  }
  updating = false;
  timer = setTimeout(update, again ? 0 : kPeriodMs);
  again = false;
}

byId('login').addEventListener('submit', (event) => {
  event.preventDefault();
  sessionStorage.setItem('farpoint-token', byId('token').value.trim());
  byId('token').value = '';
  message('');
  update();
});
byId('forget').addEventListener('click', () => {
  sessionStorage.removeItem('farpoint-token');
  location.reload();
});
byId('job-filter').addEventListener('input', () => overview && showJobs());
byId('worker-filter').addEventListener('input', () => overview && showWorkers());
byId('layer').addEventListener('change', () => {
  draw();
  for (let i = 0; i < kFetches; ++i) fetchTiles();
});
byId('stops').addEventListener('change', () => {
  forgetPixels();
  update();
});
byId('frame').addEventListener('change', () => {
  forgetPixels();
  update();
});
byId('canvas').addEventListener('mousemove', showTileAt);
byId('canvas').addEventListener('click', showTileAt);
window.addEventListener('hashchange', select);
select();
update();
