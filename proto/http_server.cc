#include "proto/http_server.h"

#include <httplib.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <openssl/err.h>
#include <openssl/pem.h>
#include <openssl/ssl.h>
#include <poll.h>
#include <sys/socket.h>
#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <cctype>
#include <cerrno>
#include <charconv>
#include <condition_variable>
#include <deque>
#include <mutex>
#include <thread>
#include <utility>
#include <vector>

#include "proto/access.h"

namespace farpoint {

namespace {

using std::chrono::steady_clock;

constexpr int kBacklog = 1024;
// How long the system keeps a connection that says nothing.
constexpr int kSilentSeconds = 5;
constexpr int kRequestsPerConnection = 100;
// How often a thread that waits looks whether the server ends.
constexpr std::chrono::milliseconds kLook{200};

template <auto Free>
struct Deleter {
  template <typename T>
  void operator()(T* object) const {
    Free(object);
  }
};
using ContextPtr = std::unique_ptr<SSL_CTX, Deleter<SSL_CTX_free>>;
using SslPtr = std::unique_ptr<SSL, Deleter<SSL_free>>;
using BioPtr = std::unique_ptr<BIO, Deleter<BIO_free_all>>;
using X509Ptr = std::unique_ptr<X509, Deleter<X509_free>>;
using KeyPtr = std::unique_ptr<EVP_PKEY, Deleter<EVP_PKEY_free>>;

BioPtr Reader(const std::string& text) {
  return BioPtr(BIO_new_mem_buf(text.data(), static_cast<int>(text.size())));
}

// Whoever connects may show any certificate: the handler judges it.
int TakeAny(int, X509_STORE_CTX*) { return 1; }

absl::StatusOr<ContextPtr> MakeContext(const TlsMaterial& tls, bool ask_for_certificate) {
  ContextPtr context(SSL_CTX_new(TLS_server_method()));
  const BioPtr chain = Reader(tls.certificate), key_text = Reader(tls.key);
  bool good = context && chain && key_text &&
              SSL_CTX_set_min_proto_version(context.get(), TLS1_2_VERSION) == 1;
  X509Ptr own(good ? PEM_read_bio_X509(chain.get(), nullptr, nullptr, nullptr) : nullptr);
  good = good && own && SSL_CTX_use_certificate(context.get(), own.get()) == 1;
  while (good) {
    X509Ptr next(PEM_read_bio_X509(chain.get(), nullptr, nullptr, nullptr));
    if (!next) break;
    good = SSL_CTX_add1_chain_cert(context.get(), next.get()) == 1;
  }
  ERR_clear_error();  // the chain's end
  const KeyPtr key(good ? PEM_read_bio_PrivateKey(key_text.get(), nullptr, nullptr, nullptr)
                        : nullptr);
  if (!good || !key || SSL_CTX_use_PrivateKey(context.get(), key.get()) != 1) {
    ERR_clear_error();
    return absl::InvalidArgumentError(
        "certificate and key cannot be used for HTTPS; make new ones with farpoint certs add");
  }
  SSL_CTX_set_mode(context.get(), SSL_MODE_ENABLE_PARTIAL_WRITE | SSL_MODE_RELEASE_BUFFERS |
                                      SSL_MODE_ACCEPT_MOVING_WRITE_BUFFER);
  // Resumed sessions would not show their certificate again.
  SSL_CTX_set_session_cache_mode(context.get(), SSL_SESS_CACHE_OFF);
  SSL_CTX_set_options(context.get(), SSL_OP_NO_TICKET | SSL_OP_NO_RENEGOTIATION);
  if (ask_for_certificate) SSL_CTX_set_verify(context.get(), SSL_VERIFY_PEER, TakeAny);
  return context;
}

// A connection with a deadline and a budget of bytes for each request.
class Connection final : public httplib::Stream {
 public:
  Connection(int fd, const HttpServerOptions& options, const std::atomic<bool>& stopping)
      : fd_(fd), options_(options), stopping_(stopping) {
    NextRequest();
  }
  ~Connection() override {
    if (ssl_ && established_) SSL_shutdown(ssl_.get());
    ERR_clear_error();
    ssl_.reset();
    ::shutdown(fd_, SHUT_RDWR);
    ::close(fd_);
  }

  bool Accept(SSL_CTX* context) {
    ssl_.reset(SSL_new(context));
    if (!ssl_ || SSL_set_fd(ssl_.get(), fd_) != 1) return false;
    for (;;) {
      ERR_clear_error();
      const int code = SSL_accept(ssl_.get());
      if (code == 1) break;
      if (!WaitFor(SSL_get_error(ssl_.get(), code))) return false;
    }
    established_ = true;
    const BioPtr out(BIO_new(BIO_s_mem()));
    const X509Ptr leaf(SSL_get1_peer_certificate(ssl_.get()));
    if (!leaf || !out) return true;
    PEM_write_bio_X509(out.get(), leaf.get());
    // Of a server: the chain without the leaf.
    if (STACK_OF(X509)* chain = SSL_get_peer_cert_chain(ssl_.get())) {
      for (int i = 0; i < sk_X509_num(chain); ++i) {
        PEM_write_bio_X509(out.get(), sk_X509_value(chain, i));
      }
    }
    const char* data = nullptr;
    const long size = BIO_get_mem_data(out.get(), &data);
    if (size > 0) certificates_.assign(data, static_cast<size_t>(size));
    return true;
  }
  const std::string& certificates() const { return certificates_; }

  // What has come begins as a request of HTTP, not as TLS does. Nothing is taken.
  bool SpeaksInTheClear() const {
    char first = 0;
    return Poll(POLLIN, deadline_) && ::recv(fd_, &first, 1, MSG_PEEK | MSG_DONTWAIT) == 1 &&
           first >= 'A' && first <= 'Z';
  }
  void Refuse() {
    static constexpr std::string_view kAnswer =
        "HTTP/1.1 400 Bad Request\r\nContent-Type: text/plain\r\nContent-Length: 40\r\n"
        "Connection: close\r\n\r\nthis port speaks TLS; say https:// here\n";
    // What was said is taken first: closing with something unread would cut the answer off.
    char said[4096];
    (void)!::recv(fd_, said, sizeof(said), MSG_DONTWAIT);
    (void)!write(kAnswer.data(), kAnswer.size());
  }

  // True when another request begins.
  bool Idle() {
    if (ssl_ && SSL_pending(ssl_.get()) > 0) return true;
    return Poll(POLLIN, steady_clock::now() + options_.idle_time);
  }
  void NextRequest() {
    deadline_ = steady_clock::now() + options_.request_time;
    budget_ = options_.max_header_bytes + options_.max_body_bytes;
    answering_ = false;
  }

  bool is_readable() const override { return Poll(POLLIN, deadline_); }
  bool is_writable() const override { return Poll(POLLOUT, deadline_); }
  ssize_t read(char* data, size_t size) override {
    size = std::min(size, budget_);
    if (size == 0) return -1;
    for (;;) {
      ssize_t n = 0;
      if (ssl_) {
        ERR_clear_error();
        n = SSL_read(ssl_.get(), data, static_cast<int>(std::min<size_t>(size, 1 << 20)));
        if (n <= 0) {
          const int error = SSL_get_error(ssl_.get(), static_cast<int>(n));
          if (error == SSL_ERROR_ZERO_RETURN) return 0;
          if (!WaitFor(error)) return -1;
          continue;
        }
      } else {
        if (!Poll(POLLIN, deadline_)) return -1;
        n = ::recv(fd_, data, size, MSG_DONTWAIT);
        if (n < 0 && (errno == EINTR || errno == EAGAIN)) continue;
        if (n <= 0) return n;
      }
      budget_ -= static_cast<size_t>(n);
      return n;
    }
  }
  ssize_t write(const char* data, size_t size) override {
    if (!answering_) {
      answering_ = true;
      deadline_ = steady_clock::now() + options_.request_time;
    }
    for (;;) {
      ssize_t n = 0;
      if (ssl_) {
        ERR_clear_error();
        n = SSL_write(ssl_.get(), data, static_cast<int>(std::min<size_t>(size, 1 << 20)));
        if (n <= 0) {
          if (!WaitFor(SSL_get_error(ssl_.get(), static_cast<int>(n)))) return -1;
          continue;
        }
        return n;
      }
      if (!Poll(POLLOUT, deadline_)) return -1;
      n = ::send(fd_, data, size, MSG_DONTWAIT | MSG_NOSIGNAL);
      if (n < 0 && (errno == EINTR || errno == EAGAIN)) continue;
      return n;
    }
  }
  void get_remote_ip_and_port(std::string&, int&) const override {}
  void get_local_ip_and_port(std::string&, int&) const override {}
  socket_t socket() const override { return fd_; }

 private:
  bool WaitFor(int error) const {
    if (error == SSL_ERROR_WANT_READ) return Poll(POLLIN, deadline_);
    if (error == SSL_ERROR_WANT_WRITE) return Poll(POLLOUT, deadline_);
    return false;
  }
  bool Poll(short events, steady_clock::time_point until) const {
    for (;;) {
      const auto now = steady_clock::now();
      if (now >= until || stopping_.load()) return false;
      const auto left = std::chrono::ceil<std::chrono::milliseconds>(until - now);
      pollfd one{.fd = fd_, .events = events, .revents = 0};
      const int n = ::poll(&one, 1, static_cast<int>(std::min(left, kLook).count()));
      if (n < 0 && errno != EINTR) return false;
      if (n > 0) return (one.revents & (events | POLLHUP)) != 0;
    }
  }

  const int fd_;
  const HttpServerOptions& options_;
  const std::atomic<bool>& stopping_;
  SslPtr ssl_;
  bool established_ = false, answering_ = false;
  steady_clock::time_point deadline_;
  size_t budget_ = 0;
  std::string certificates_;
};

// void, and from cpp-httplib 0.14 on bool: whether the task was taken.
using Enqueued = decltype(std::declval<httplib::TaskQueue&>().enqueue(std::function<void()>()));

// Threads that take connections; who brings one while all are busy waits.
class BoundedPool final : public httplib::TaskQueue {
 public:
  explicit BoundedPool(size_t threads) {
    for (size_t i = 0; i < threads; ++i) threads_.emplace_back([this] { Work(); });
  }
  Enqueued enqueue(std::function<void()> task) override {
    std::unique_lock lock(mutex_);
    room_.wait(lock, [this] { return tasks_.size() < threads_.size(); });
    tasks_.push_back(std::move(task));
    lock.unlock();
    work_.notify_one();
    return static_cast<Enqueued>(true);
  }
  void shutdown() override {
    {
      std::lock_guard lock(mutex_);
      ending_ = true;
    }
    work_.notify_all();
    for (std::thread& thread : threads_) thread.join();
  }

 private:
  void Work() {
    for (;;) {
      std::unique_lock lock(mutex_);
      work_.wait(lock, [this] { return ending_ || !tasks_.empty(); });
      if (tasks_.empty()) return;
      const std::function<void()> task = std::move(tasks_.front());
      tasks_.pop_front();
      lock.unlock();
      room_.notify_one();
      task();
    }
  }

  std::vector<std::thread> threads_;
  std::mutex mutex_;
  std::condition_variable work_, room_;
  std::deque<std::function<void()>> tasks_;  // guarded by mutex_
  bool ending_ = false;                      // guarded by mutex_
};

class HttpServerImpl final : public HttpServer, private httplib::Server {
 public:
  HttpServerImpl(HttpServerOptions options, HttpServer::Handler handler)
      : options_(std::move(options)), handler_(std::move(handler)) {}
  ~HttpServerImpl() override {
    stopping_ = true;
    stop();
    if (thread_.joinable()) thread_.join();
  }

  absl::Status Listen() {
    if (options_.tls) {
      FP_ASSIGN_OR_RETURN(context_, MakeContext(*options_.tls, options_.ask_for_certificate));
    }
    HostPort at = SplitHostPort(options_.address);
    if (at.host.size() > 2 && at.host.front() == '[')
      at.host = at.host.substr(1, at.host.size() - 2);
    int port = 0;
    std::from_chars(at.port.data(), at.port.data() + at.port.size(), port);
    set_socket_options([](socket_t fd) {
      const int on = 1;
      ::setsockopt(fd, SOL_SOCKET, SO_REUSEADDR, &on, sizeof(on));
      ::setsockopt(fd, IPPROTO_TCP, TCP_DEFER_ACCEPT, &kSilentSeconds, sizeof(kSilentSeconds));
    });
    set_tcp_nodelay(true);
    set_payload_max_length(options_.max_body_bytes);
    set_keep_alive_max_count(kRequestsPerConnection);
    new_task_queue = [this] { return new BoundedPool(options_.threads); };
    set_default_headers(
        {{"Content-Security-Policy",
          "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; "
          "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"},
         {"X-Content-Type-Options", "nosniff"},
         {"Referrer-Policy", "no-referrer"},
         {"Cross-Origin-Resource-Policy", "same-origin"},
         {"Cache-Control", "no-store"}});
    const auto serve = [this](const httplib::Request& request, httplib::Response& response) {
      Serve(request, response);
    };
    Get(".*", serve);
    Post(".*", serve);
    if (port == 0) {
      port_ = bind_to_any_port(at.host);
    } else {
      port_ = bind_to_port(at.host, port) ? port : -1;
    }
    if (port_ <= 0) {
      return absl::UnavailableError("cannot listen on '" + options_.address +
                                    "'; is the port taken, or the address another machine's?");
    }
    ::listen(svr_sock_, kBacklog);  // again: the library asks for five
    thread_ = std::thread([this] { listen_after_bind(); });
    // A stop before the loop has begun would be lost.
    while (!is_running()) std::this_thread::sleep_for(std::chrono::milliseconds(1));
    return absl::OkStatus();
  }
  int port() const override { return port_; }
  absl::Status Renew(const TlsMaterial& tls) override {
    if (!options_.tls) return absl::FailedPreconditionError("this server speaks in the clear");
    FP_ASSIGN_OR_RETURN(ContextPtr context, MakeContext(tls, options_.ask_for_certificate));
    std::lock_guard lock(context_mutex_);
    context_ = std::move(context);
    return absl::OkStatus();
  }

 private:
  std::shared_ptr<SSL_CTX> Context() {
    std::lock_guard lock(context_mutex_);
    return context_;
  }
  bool process_and_close_socket(socket_t fd) override {
    Connection connection(fd, options_, stopping_);
    if (const std::shared_ptr<SSL_CTX> context = Context()) {
      if (connection.SpeaksInTheClear()) {
        connection.Refuse();
        return true;
      }
      if (!connection.Accept(context.get())) return false;
    }
    for (int left = kRequestsPerConnection; left > 0 && !stopping_.load(); --left) {
      if (!connection.Idle()) return true;
      connection.NextRequest();
      bool closed = false;
      current_certificates = &connection.certificates();
      const bool answered = Process(connection, left == 1, closed);
      current_certificates = nullptr;
      if (!answered || closed) return true;
    }
    return true;
  }

  // Newer versions want addresses, which they only tell the handler.
  template <typename Stream>
  bool Process(Stream& connection, bool last, bool& closed) {
    const auto set_up = [](httplib::Request& request) {
      // Nothing announced is no body; the library would read until the peer closes.
      if (!request.has_header("Content-Length") && !request.has_header("Transfer-Encoding")) {
        request.set_header("Content-Length", "0");
      }
    };
    if constexpr (requires { this->process_request(connection, last, closed, set_up); }) {
      return this->process_request(connection, last, closed, set_up);
    } else {
      return this->process_request(connection, "", 0, "", 0, last, closed, set_up);
    }
  }

  void Serve(const httplib::Request& from, httplib::Response& to) {
    HttpRequest request{.method = from.method, .path = from.path};
    for (const auto& [name, value] : from.params) request.query.emplace(name, value);
    for (const auto& [name, value] : from.headers) {
      std::string lower = name;
      std::transform(lower.begin(), lower.end(), lower.begin(),
                     [](unsigned char c) { return std::tolower(c); });
      request.headers.emplace(std::move(lower), value);
    }
    if (current_certificates != nullptr) request.certificates = *current_certificates;
    const HttpResponse response = handler_(request);
    to.status = response.status;
    to.set_content(response.body, response.content_type);
  }

  // Of the connection that this thread serves.
  static thread_local const std::string* current_certificates;

  const HttpServerOptions options_;
  const HttpServer::Handler handler_;
  std::mutex context_mutex_;
  std::shared_ptr<SSL_CTX> context_;  // guarded by context_mutex_; null: in the clear
  std::atomic<bool> stopping_ = false;
  int port_ = -1;
  std::thread thread_;
};

thread_local const std::string* HttpServerImpl::current_certificates = nullptr;

}  // namespace

std::string HttpRequest::Header(const std::string& name) const {
  const auto at = headers.find(name);
  return at == headers.end() ? "" : at->second;
}
std::string HttpRequest::Query(const std::string& name) const {
  const auto at = query.find(name);
  return at == query.end() ? "" : at->second;
}

int HttpStatusOf(const absl::Status& status) {
  switch (status.code()) {
    case absl::StatusCode::kOk:
      return 200;
    case absl::StatusCode::kInvalidArgument:
    case absl::StatusCode::kOutOfRange:
      return 400;
    case absl::StatusCode::kUnauthenticated:
      return 401;
    case absl::StatusCode::kPermissionDenied:
      return 403;
    case absl::StatusCode::kNotFound:
      return 404;
    case absl::StatusCode::kFailedPrecondition:
    case absl::StatusCode::kAlreadyExists:
    case absl::StatusCode::kAborted:
      return 409;
    case absl::StatusCode::kResourceExhausted:
      return 429;
    case absl::StatusCode::kUnavailable:
    case absl::StatusCode::kDeadlineExceeded:
      return 503;
    default:
      return 500;
  }
}

absl::StatusOr<std::unique_ptr<HttpServer>> HttpServer::Start(HttpServerOptions options,
                                                              Handler handler) {
  auto server = std::make_unique<HttpServerImpl>(std::move(options), std::move(handler));
  FP_RETURN_IF_ERROR(server->Listen());
  return server;
}

}  // namespace farpoint
