// A controller for `splatctrl replay --controller-command ./reach`: proportional to the error, and within the clearance
// rows. Build: c++ -std=c++17 -O2 -o reach reach.cpp
#include <algorithm>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <iostream>
#include <string>
#include <vector>

using Numbers = std::vector<double>;

// The numbers of a key, nested arrays one after the other; from `at` on, which moves behind them. None without the key.
Numbers numbers(const std::string& line, const std::string& key, std::size_t& at) {
  Numbers found;
  const std::size_t place = line.find("\"" + key + "\":", at);
  if (place == std::string::npos) return found;
  const char* text = line.c_str() + place + key.size() + 3;
  int depth = 0;
  do {
    char* end = nullptr;
    const double number = std::strtod(text, &end);
    if (end != text) {
      found.push_back(number);
      text = end;
    } else {
      depth += (*text == '[') - (*text == ']');
      ++text;
    }
  } while (depth > 0 && *text);
  at = text - line.c_str();
  return found;
}

Numbers numbers(const std::string& line, const std::string& key) {
  std::size_t at = 0;
  return numbers(line, key, at);
}

double dot(const Numbers& a, const Numbers& b) {
  double sum = 0.0;
  for (std::size_t j = 0; j < a.size(); ++j) sum += a[j] * b[j];
  return sum;
}

// Solve A x = b, A (6, 6) symmetric and positive definite.
Numbers solved(std::vector<Numbers> A, Numbers b) {
  for (int i = 0; i < 6; ++i)
    for (int k = i + 1; k < 6; ++k) {
      const double factor = A[k][i] / A[i][i];
      for (int j = i; j < 6; ++j) A[k][j] -= factor * A[i][j];
      b[k] -= factor * b[i];
    }
  for (int i = 5; i >= 0; --i) {
    for (int j = i + 1; j < 6; ++j) b[i] -= A[i][j] * b[j];
    b[i] /= A[i][i];
  }
  return b;
}

int main() {
  const double gain = 2.0, fastest = 0.25, damping = 0.05;  // [1/s]; [m/s, rad/s] of the frame
  std::string line;
  std::getline(std::cin, line);
  if (numbers(line, "protocol") != Numbers{1.0}) return 1;
  const Numbers limit = numbers(line, "velocity_limit");
  std::cout << "{\"protocol\": 1}" << std::endl;
  while (std::getline(std::cin, line)) {
    const long id = std::lround(numbers(line, "id").at(0));
    const Numbers flat = numbers(line, "jacobian"), moving = numbers(line, "goal_twist");
    Numbers twist = numbers(line, "error"), velocity(limit.size(), 0.0);
    std::vector<Numbers> J, A(6, Numbers(6));
    for (int i = 0; i < 6; ++i) J.emplace_back(flat.begin() + i * limit.size(), flat.begin() + (i + 1) * limit.size());
    const double scale = std::min(gain, fastest / std::max(std::sqrt(dot(twist, twist)), 1e-9));
    for (int i = 0; i < 6; ++i) {
      for (int k = 0; k < 6; ++k) A[i][k] = dot(J[i], J[k]) + (i == k ? damping * damping : 0.0);
      twist[i] = scale * twist[i] + (moving.empty() ? 0.0 : moving[i]);
    }
    const Numbers x = solved(A, twist);
    for (int i = 0; i < 6; ++i)
      for (std::size_t j = 0; j < velocity.size(); ++j) velocity[j] += J[i][j] * x[i];

    std::cout << "{\"id\": " << id << ", \"ask\": \"rows\"}" << std::endl;
    std::getline(std::cin, line);
    std::vector<Numbers> G;
    Numbers h;
    for (std::size_t at = 0;;) {
      const Numbers row = numbers(line, "G", at);
      if (row.empty()) break;
      G.push_back(row);
      h.push_back(numbers(line, "h", at).at(0));
    }
    for (int round = 0; round < 200; ++round) {  // onto the row that is broken most, until none is
      double most = 0.0;
      std::size_t worst = 0;
      for (std::size_t i = 0; i < G.size(); ++i) {
        const double length = std::sqrt(dot(G[i], G[i]));
        const double excess = length > 0.0 ? (dot(G[i], velocity) - h[i]) / length : 0.0;
        if (excess > most) most = excess, worst = i;
      }
      if (most <= 0.0) break;
      const double length = std::sqrt(dot(G[worst], G[worst]));
      for (std::size_t j = 0; j < velocity.size(); ++j) velocity[j] -= most * G[worst][j] / length;
    }
    std::printf("{\"id\": %ld, \"velocity\": [", id);
    for (std::size_t j = 0; j < velocity.size(); ++j)
      std::printf("%s%.17g", j ? ", " : "", std::clamp(velocity[j], -limit[j], limit[j]));
    std::printf("]}\n");
    std::fflush(stdout);
  }
}
